#!/usr/bin/env bash
# Validate the Compose files against the schema of the Compose specification, which version 2 implements, as the docker-compose 1.29.2 package carries it; needs no engine.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet jsonschema pyyaml
"$work/venv/bin/pip" download --quiet --no-deps --dest "$work" docker-compose==1.29.2
"$work/venv/bin/python" - "$work"/docker_compose-*.whl deploy/compose*.yaml <<'PYTHON'
import json, sys, zipfile
import jsonschema, yaml

schema = json.loads(zipfile.ZipFile(sys.argv[1]).read("compose/config/compose_spec.json"))
for path in sys.argv[2:]:
    with open(path) as file:
        compose = yaml.safe_load(file)
    jsonschema.validate(compose, schema)
    print(f"{path} fits the Compose schema; services:", ", ".join(compose["services"]))
PYTHON
