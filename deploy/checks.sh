# What the checks on real engines have in common; they source this file.

skip() { echo "SKIP: $*"; exit 0; }
fail() { echo "FAILED: $*"; exit 1; }
wait_for() { # SECONDS WHAT COMMAND...: until the command succeeds
    local until=$((SECONDS + $1)) what=$2
    shift 2
    until "$@" > /dev/null 2>&1; do
        [ $SECONDS -lt $until ] || fail "no $what"
        sleep 0.5
    done
}
