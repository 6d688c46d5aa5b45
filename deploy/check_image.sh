#!/usr/bin/env bash
# Run the Dockerfile's steps by hand in a clean Debian 12 root, then a small run as its user. Needs root and debootstrap.
# WHEELS may name a folder of wheels that pip should look into; the host's pip configuration is taken along.
set -euo pipefail
cd "$(dirname "$0")/.."
command -v debootstrap >/dev/null || { echo "check_image: needs debootstrap (apt-get install debootstrap)" >&2; exit 1; }
root=$(mktemp -d)
chmod 755 "$root"
trap 'umount -q "$root/wheels" "$root/proc" "$root/dev" 2>/dev/null; rm -rf --one-file-system "$root"' EXIT
mirror=$(grep -rhoE 'https?://[^ ]+/debian/?( |$)' /etc/apt/sources.list /etc/apt/sources.list.d 2>/dev/null | head -n 1 | tr -d ' ' || true)
debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$root" ${mirror:+"$mirror"} >"$root.log" 2>&1 \
  || { tail -n 20 "$root.log" >&2; exit 1; }
mount -t proc proc "$root/proc"
mount --bind /dev "$root/dev"
cp /etc/resolv.conf /etc/hosts "$root/etc/" 2>/dev/null || true
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/" 2>/dev/null || true
pip config list | sed -nE "s/^(:env:|global)\.([a-z-]+)='(.*)'$/\2 = \3/p" | sort -u -t= -k1,1 \
  | { echo "[global]"; cat; } >"$root/etc/pip.conf"
if [ -n "${WHEELS:-}" ]; then
  mkdir -p "$root$WHEELS" && mount --bind "$WHEELS" "$root$WHEELS"
  trap 'umount -q "$root$WHEELS" "$root/proc" "$root/dev" 2>/dev/null; rm -rf --one-file-system "$root"' EXIT
fi
mkdir -p "$root/src"
git archive HEAD | tar -x -C "$root/src"
inside() { chroot "$root" env -i PATH=/opt/coop/bin:/usr/bin:/bin:/usr/sbin:/sbin LANG=C.UTF-8 "$@"; }
sed -nE 's/^RUN (.*)$/\1/p' deploy/Dockerfile | while read -r step; do
  echo "RUN $step"
  inside sh -ec "cd /src && $step"
done
user=$(sed -nE 's/^USER (.*)$/\1/p' deploy/Dockerfile)
inside su "$user" -s /bin/sh -c 'export PATH=/opt/coop/bin:$PATH; cd /runs && id -un \
  && for role in learner replay actor local; do coop-$role --help >/dev/null; done \
  && coop-local --preset cartpole --total-steps 1000 --run-dir /runs/check'
test -e "$root/runs/check/summary.json"
echo "check_image: passed"
