#!/bin/bash
# Runs head.sbatch, actors.sbatch and coop-sweep --slurm on a real Slurm controller with three nodes on this machine: `make slurm-test`.
# Parts of the run are requeued, cancelled and added in its middle. Takes about nine minutes, as Slurm holds requeued jobs for two. Needs root, and installs slurm-wlm where it is missing.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
bin=${BIN:?is not set: the folder with coop-local and coop-sweep}
PATH=$(cd "$bin" && pwd):$PATH

. "$here/../checks.sh"
[ "$(id -u)" = 0 ] || skip "a Slurm controller of one's own needs root"
if ! command -v slurmctld slurmd munged > /dev/null; then
    apt-get install --yes --quiet slurm-wlm > /dev/null 2>&1 || skip "slurm-wlm is not installed, and apt-get can't install it"
fi

work=$(mktemp -d)
chmod 755 "$work"
export SLURM_CONF=$work/slurm.conf OMP_NUM_THREADS=1
finish() {
    scancel --quiet --user=root 2> /dev/null || true
    # A job's end is told to the controller; without one, its node would wait for ever.
    for _ in $(seq 60); do [ -n "$(squeue --noheader 2> /dev/null)" ] || break; sleep 1; done
    local pids
    pids=$(cat "$work"/*.pid) || true
    kill $pids 2> /dev/null || true
    for pid in $pids; do while kill -0 "$pid" 2> /dev/null; do sleep 0.2; done; done
    [ "$failed" = 0 ] || tail -n 5 "$work"/*.log "$work"/*.out
    rm -rf "$work"
}
failed=1
trap finish EXIT

mkdir -p "$work/munge" "$work/state"
dd if=/dev/urandom of="$work/munge/key" bs=1 count=1024 status=none
chmod 400 "$work/munge/key"
munged --force --socket="$work/munge/socket" --key-file="$work/munge/key" --pid-file="$work/munge.pid" \
    --log-file="$work/munge/log" --seed-file="$work/munge/seed"
host=$(hostname -s)
cat > "$SLURM_CONF" <<CONF
ClusterName=check
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
AuthType=auth/munge
AuthInfo=socket=$work/munge/socket
SlurmUser=root
StateSaveLocation=$work/state
SlurmctldPidFile=$work/slurmctld.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdPidFile=$work/slurmd-%n.pid
SlurmdLogFile=$work/slurmd-%n.log
SlurmdSpoolDir=$work/spool-%n
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
MinJobAge=3600
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1
NodeName=n[1-3] NodeHostname=$host NodeAddr=127.0.0.1 Port=[16818-16820] CPUs=4 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
slurmctld
for node in n1 n2 n3; do slurmd -N "$node"; done

state() { scontrol show job "$1" | grep -o 'JobState=[A-Z]*' | head -n 1; }
steps() { tail -n 1 "$RUN_DIR/metrics.jsonl" | grep -o '"env_step": [0-9]*' | grep -o '[0-9]*'; }
reached() { [ "$(steps)" -ge "$1" ]; }
running() { [ "$(squeue --noheader --states=running --array | wc -l)" -ge "$1" ]; }
finished() { [ -z "$(squeue --noheader)" ]; }
complete() { grep -q '"exit": "complete"' "$RUN_DIR/summary.json"; }

wait_for 60 "three idle nodes" bash -c '[ "$(sinfo --noheader --states=idle --format=%D)" = 3 ]'

echo "a distributed run: head on one node, three actors"
export RUN_DIR=$work/run
head=$(sbatch --parsable --output="$work/head.out" "$here/head.sbatch" --preset cartpole --method coop --total-steps 6000 --checkpoint-every 500)
actors=$(sbatch --parsable --array=1-3 --output="$work/actor-%a.out" "$here/actors.sbatch")
wait_for 240 "500 steps" reached 500
echo "one actor requeued, one cancelled, two added: $(steps) steps"
scontrol requeue "${actors}_1"
scancel "${actors}_2"
sbatch --parsable --array=4-5 --output="$work/actor-%a.out" "$here/actors.sbatch" > /dev/null
wait_for 240 "1500 steps" reached 1500
echo "head requeued: $(steps) steps"
scontrol requeue "$head"
wait_for 600 "2500 steps after the head is back" reached 2500
grep -q "^resuming from checkpoint" "$work/head.out" || fail "the head began anew"
echo "head told that its time is nearly up: $(steps) steps"
scancel --batch --signal=USR1 "$head"
wait_for 600 "3500 steps after the head has requeued itself" reached 3500
[ "$(grep -c "^resuming from checkpoint" "$work/head.out")" = 2 ] || fail "the head did not go on twice"
echo "head cancelled: $(steps) steps"
scancel "$head"
wait_for 180 "end of the head" bash -c "[ ! -e '$RUN_DIR/endpoint' ]"
grep -q '"exit": "interrupted"' "$RUN_DIR/summary.json" || fail "no summary of a clean stop"
head=$(sbatch --parsable --output="$work/head-2.out" "$here/head.sbatch" --preset cartpole --method coop --total-steps 6000 --checkpoint-every 500)
wait_for 600 "end of the run" complete
wait_for 180 "end of its jobs" finished
grep -E '"(env_steps|transitions_accepted|transitions_lost|duplicates_refused|exit)"' "$RUN_DIR/summary.json"
grep -q '"transitions_lost": 0' "$RUN_DIR/summary.json" || fail "transitions are lost"

echo "a sweep of four cells, one requeued"
printf 'title = "four"\npreset = "cartpole"\nmethods = ["dqn", "coop"]\nseeds = [0, 1]\n[fixed]\ntotal_steps = 3000\n' > "$work/four.toml"
coop-sweep "$work/four.toml" --slurm --dir "$work/four"
wait_for 180 "running cells" running 2
wait_for 180 "cell with episodes" bash -c "ls '$work'/four/*/episodes.csv"
cell=$(squeue --noheader --states=running --format=%i | head -n 1)
scontrol requeue "$cell"
coop-sweep "$work/four.toml" --slurm --dir "$work/four"
wait_for 600 "end of the sweep" finished
[ "$(grep -l '"exit": "complete"' "$work"/four/*/summary.json | wc -l)" = 4 ] || fail "not all four cells are complete"

echo "a sweep of two cells that one task runs at once, after its setup"
printf 'preset = "cartpole"\nmethods = ["dqn"]\nseeds = [0, 1]\n[fixed]\ntotal_steps = 3000\n' > "$work/two.toml"
coop-sweep "$work/two.toml" --slurm --per-task 2 --setup "touch '$work/setup'" --dir "$work/two"
wait_for 600 "end of the second sweep" finished
[ -e "$work/setup" ] || fail "the setup has not run"
[ "$(grep -l '"exit": "complete"' "$work"/two/*/summary.json | wc -l)" = 2 ] || fail "not both cells are complete"
echo "passed: run complete, nothing lost; 4 of 4 and 2 of 2 cells complete"
failed=0
