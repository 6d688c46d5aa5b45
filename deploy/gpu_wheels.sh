#!/usr/bin/env bash
# The wheels for a GPU machine without network, with Python 3.12, PyTorch with CUDA and little else, in .whl/ (20 MB).
# PYTHON: whose pip fetches them; any version.
set -eu
cd "$(dirname "$0")/.."
packages="ale-py docstring-parser eclipse-zenoh farama-notifications gymnasium markdown-it-py mdurl msgpack msgspec
    pygments rich stable-baselines3 threadpoolctl tomli-w typeguard tyro"
platforms=$(printf ' --platform manylinux_2_%s_x86_64' 17 24 27 28 31 34; printf ' --platform manylinux2014_x86_64')
rm -rf .whl
# shellcheck disable=SC2086 # words are meant
"${PYTHON:-python3}" -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: --python-version 3.12 \
    --implementation cp $platforms --constraint constraints.txt --dest .whl $packages
du -sh .whl
