#!/bin/bash
# Builds the image and runs deploy/compose.yaml and its overlays on a real engine: `make compose-test`.
# A process of each role is killed with -9, actors are added and removed, the run is stopped and continued. Takes about ten minutes on two cores.
# Needs root, and installs docker.io, docker-compose and debootstrap where they are missing. It starts an engine of its own where none runs, pulls nothing
# (the base image is a debootstrap of Debian 12), and ends and removes what it has started.
set -eu
cd "$(dirname "$0")/.."

. deploy/checks.sh
[ "$(id -u)" = 0 ] || skip "a container engine of one's own needs root"
for tool in dockerd:docker.io docker-compose:docker-compose debootstrap:debootstrap; do
    if ! command -v "${tool%:*}" > /dev/null; then
        apt-get install --yes --quiet --no-install-recommends "${tool#*:}" iptables > /dev/null 2>&1 \
            || skip "${tool#*:} is not installed, and apt-get can't install it"
    fi
done

work=$(mktemp -d)
chmod 755 "$work"
engine=
failed=1
finish() {
    [ "$failed" = 0 ] || { compose logs --tail=15 2> /dev/null || true; tail -n 5 "$work"/*.log; } 2>&1 | tail -n 80
    compose down --volumes --remove-orphans > /dev/null 2>&1 || true
    if [ -n "$engine" ]; then
        kill "$engine" && tail --pid="$engine" -f /dev/null # dockerd ends containerd, its child
        iptables-restore < "$work/rules" # dockerd leaves its rules, bridges and forwarding behind
        for link in $(ls /sys/class/net); do grep -qx "$link" "$work/links" || ip link delete "$link"; done
        cat "$work/forwarding" > /proc/sys/net/ipv4/ip_forward
    fi
    for place in $(awk -v work="$work/" 'index($2, work) == 1 { print $2 }' /proc/mounts | sort -r); do umount -l "$place"; done
    rm -rf --one-file-system "$work"
}
trap finish EXIT
quietly() { "$@" > "$work/step.log" 2>&1 || fail "$*"; }

files="-f deploy/compose.yaml"
compose() { docker-compose -p coop-check $files "$@"; }
if ! docker info > /dev/null 2>&1; then
    export DOCKER_HOST=unix://$work/docker.sock
    iptables-save > "$work/rules"
    ls /sys/class/net > "$work/links"
    cat /proc/sys/net/ipv4/ip_forward > "$work/forwarding"
    dockerd --host "$DOCKER_HOST" --data-root "$work/data" --exec-root "$work/exec" --pidfile "$work/dockerd.pid" > "$work/dockerd.log" 2>&1 &
    engine=$!
    up() { kill -0 "$engine" || return 0; docker info; }
    wait_for 60 "engine" up
    kill -0 "$engine" 2> /dev/null || { engine=; skip "dockerd does not run here: $(tail -n 1 "$work/dockerd.log")"; }
fi

base=python:3.11-slim-bookworm
if ! docker image inspect $base > /dev/null 2>&1; then
    echo "base image: debootstrap of bookworm"
    mirror=$(grep -rhoE 'https?://[^ ]+/debian/?( |$)' /etc/apt/sources.list /etc/apt/sources.list.d 2> /dev/null | head -n 1 | tr -d ' ' || true)
    quietly debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$work/root" ${mirror:+"$mirror"}
    rm -rf "$work"/root/var/cache/apt/* "$work"/root/var/lib/apt/lists/* "$work"/root/usr/share/{doc,locale,man}/*
    quietly tar -C "$work/root" -cf "$work/root.tar" .
    quietly docker import "$work/root.tar" $base
fi
# The image to build in has this machine's certificates, folders of wheels and pip configuration.
pip=$(command -v "${PIP:-pip}") || fail "no pip"
"$pip" config list | deploy/builder_image.sh $base "$work/builder"
quietly docker build --tag coop-builder "$work/builder"
export BUILDER=coop-builder BUILD_NETWORK=host
began=$SECONDS
quietly compose build
size=$(docker image inspect --format '{{.Size}}' coop)
echo "image: $((size / 1000000)) MB, built in $((SECONDS - began)) s"
[ "$size" -lt 1200000000 ] || fail "an image of $size bytes"
docker run --rm coop sh -c '! command -v gcc make pip && id -un' | grep -qx coop || fail "build tools, or root, in the image"

ids() { compose ps --quiet "$1"; }
one() { ids "$1" | head -n 1; }
inside() { docker exec "$(one learner)" "$@"; }
status() { inside coop-watch --run compose --once --json --join-timeout 20; }
steps() { inside sh -c 'tail -n 1 /runs/compose/metrics.jsonl' | grep -o '"env_step": [0-9]*' | grep -o '[0-9]*'; }
reached() { [ "$(steps)" -ge "$1" ]; }
joined() { status | grep -q "\"actor\": $1[,}]"; }
again() { # ID COUNT: the engine has restarted a container this often, and it runs
    [ "$(docker inspect --format '{{.RestartCount}} {{.State.Running}}' "$1")" = "$2 true" ]
}
healthy() { [ "$(docker inspect --format '{{.State.Health.Status}}' "$(one "$1")")" = healthy ]; }
summary() { docker run --rm --volume coop-check_runs:/runs:ro coop cat /runs/compose/summary.json; }
ended() { summary | grep -q "\"exit\": \"$1\""; }
complete() { # of one run with an overlay
    wait_for 1800 "end of the run" ended complete
    summary | grep -E '"(env_steps|transitions_accepted|transitions_lost|duplicates_refused|exit)"'
    summary | grep -q '"transitions_lost": 0' || fail "transitions are lost"
}

echo "a run: learner, replay service, four actors, TensorBoard"
export STEPS=40000 LEARNER_CPUS=0.15 # slow enough to be still running when it is stopped
quietly compose up --detach --scale actor=4
wait_for 300 "four actors" joined 4
wait_for 300 "500 steps" reached 500
for role in actor replay learner; do
    id=$(one $role)
    kill -9 "$(docker inspect --format '{{.State.Pid}}' "$id")"
    wait_for 60 "restarted $role" again "$id" 1
    before=$(steps)
    wait_for 300 "steps after the kill of the $role" reached $((before + 300))
    echo "$role killed with -9 and restarted by the engine: $before steps, then $(steps)"
done
quietly compose up --detach --no-recreate --scale actor=2
wait_for 120 "two actors" joined 2
quietly compose up --detach --no-recreate --scale actor=5
wait_for 300 "five actors" joined 5
echo "actors: 4, 2, 5; $(steps) steps"
for role in learner replay actor tensorboard; do wait_for 300 "healthy $role" healthy $role; done
echo "healthy: learner, replay service, actors, TensorBoard"
quietly compose stop
ended interrupted || fail "the run was not stopped cleanly"
echo "stopped: $(summary | grep -o '"env_steps": [0-9]*')"
export LEARNER_CPUS=0
quietly compose up --detach --scale actor=5
complete
quietly compose down --volumes

echo "a run with mutual TLS"
deploy/zenoh/make_keys.sh "$work/keys" learner replay > /dev/null
chmod 755 "$work/keys" && chown 1000 "$work"/keys/*.json5
export KEYS=$work/keys STEPS=1500
files="-f deploy/compose.yaml -f deploy/compose.tls.yaml"
quietly compose up --detach --scale actor=2
complete
quietly compose down --volumes

echo "a run behind a router"
files="-f deploy/compose.yaml -f deploy/compose.router.yaml"
quietly compose up --detach --scale actor=2
complete
echo "passed: one process of each role killed and restarted, nothing lost; TLS and router complete"
failed=0
