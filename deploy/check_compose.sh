#!/usr/bin/env bash
# Validate compose.yaml against the Compose schema that the docker-compose 1.29.2 package carries; needs no engine.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet jsonschema pyyaml
"$work/venv/bin/pip" download --quiet --no-deps --dest "$work" docker-compose==1.29.2
"$work/venv/bin/python" - "$work"/docker_compose-*.whl deploy/compose.yaml <<'PYTHON'
import json, sys, zipfile
import jsonschema, yaml

schema = json.loads(zipfile.ZipFile(sys.argv[1]).read("compose/config/compose_spec.json"))
compose = yaml.safe_load(open(sys.argv[2]))
compose.pop("name", None)  # newer than this schema
jsonschema.validate(compose, schema)
print("compose.yaml fits the Compose schema; services:", ", ".join(compose["services"]))
PYTHON
