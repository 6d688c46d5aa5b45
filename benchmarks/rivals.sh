#!/bin/sh
# Makes the virtual environments of the rivals of `make bench` in .bench/, each once: benchmarks/rivals.sh [NAME ...]
# JAX has its own, and Reverb, which needs an older numpy than ours.
set -eu
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python3}

venv() { # name, what to install
    ready=.bench/$1/.installed
    if [ ! -e "$ready" ]; then
        echo "setting up .bench/$1: some minutes and 1 to 2 GB" >&2
        rm -rf ".bench/$1"
        "$PYTHON" -m venv ".bench/$1"
        name=$1
        shift
        ".bench/$name/bin/python" -m pip install --quiet --disable-pip-version-check "$@"
        touch "$ready"
    fi
}

[ $# -gt 0 ] || set -- bench jax reverb
for name in "$@"; do
    case $name in
    bench) venv bench --constraint constraints.txt --editable '.[bench]' ;;
    jax | reverb) venv "$name" --requirement "benchmarks/$name/requirements.txt" ;;
    *) echo "$0: no environment $name" >&2; exit 2 ;;
    esac
done
