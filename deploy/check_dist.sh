#!/usr/bin/env bash
# Build sdist and wheel into dist/, install the wheel in a fresh environment outside of the checkout, and use it there.
# PYTHON names the interpreter to try it with, python3 by default; BUILDER one that has the package build.
set -euo pipefail
cd "$(dirname "$0")/.."
constraints=$PWD/constraints.txt
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
rm -rf dist
quietly() { "$@" >"$folder/log" 2>&1 || { tail -n 20 "$folder/log" >&2; exit 1; }; }
quietly "${BUILDER:-python3}" -m build --outdir dist .
wheel=$(readlink -f dist/*.whl)
cd "$folder"
"${PYTHON:-python3}" -m venv venv
quietly venv/bin/python -m pip install --disable-pip-version-check --constraint "$constraints" "$wheel[report]"
version=$(basename "$wheel" | cut -d- -f2)
for command in venv/bin/coop-*; do
  test "$("$command" --version)" = "$(basename "$command") $version" || { echo "$command: not version $version" >&2; exit 1; }
  "$command" --help >/dev/null
done
venv/bin/coop-lockstep --preset cartpole --total-steps 500 --run-dir runs/lockstep
venv/bin/coop-local --preset cartpole --total-steps 500 --run-dir runs/local
venv/bin/coop-sweep small-buffers --quick --cell dqn-capacity=50-eviction=fifo-ratio=0.25-seed=0 --dir runs/sweep
venv/bin/coop-report runs/sweep | tail -n 1
for run in lockstep local; do grep -q '"exit": "complete"' "runs/$run/summary.json"; done
echo "check_dist: $(basename "$wheel") runs with $(venv/bin/python --version)"
