#!/bin/sh
# Makes a small certificate authority and a Zenoh configuration with a certificate of its own for learner, replay
# service, actors and evaluators:
#   deploy/zenoh/make_keys.sh FOLDER [NAME-OR-ADDRESS ...]
# The names are those that learner and replay service are reached by (default: localhost 127.0.0.1). Each of
# FOLDER/learner.json5, replay.json5, actor.json5 and evaluator.json5 is all that a machine needs for --zenoh-config,
# and holds a private key.
# FOLDER/ca.key signs new ones: keep it off the machines of the run. DAYS sets how long certificates hold.
set -eu
umask 077
here=$(cd "$(dirname "$0")" && pwd)
folder=${1:?"usage: $0 FOLDER [NAME-OR-ADDRESS ...]"}
shift
[ $# -gt 0 ] || set -- localhost 127.0.0.1
days=${DAYS:-365}
[ ! -e "$folder" ] || { echo "$folder: exists already" >&2; exit 1; }
mkdir -p "$folder"
cd "$folder"

names=
for name; do
    case $name in
        *:* | [0-9]*.[0-9]*.[0-9]*.[0-9]*) names="$names,IP:$name" ;;
        *) names="$names,DNS:$name" ;;
    esac
done

key() { openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$1"; }

line() { openssl base64 -A -in "$1"; }

# certificate ROLE TEMPLATE EXTENSIONS
certificate() {
    key "$1.key"
    openssl req -new -key "$1.key" -subj "/CN=$1" -out "$1.csr"
    printf 'basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\n%b\n' "$3" > "$1.ext"
    openssl x509 -req -in "$1.csr" -CA ca.pem -CAkey ca.key -set_serial "0x$(openssl rand -hex 16 | sed 's/^./1/')" \
        -days "$days" -sha256 -extfile "$1.ext" -out "$1.pem" 2> /dev/null
    sed -e "s|@CA@|$(line ca.pem)|" -e "s|@CERTIFICATE@|$(line "$1.pem")|" -e "s|@KEY@|$(line "$1.key")|" \
        "$here/$2.json5" > "$1.json5"
    rm "$1.key" "$1.csr" "$1.ext" "$1.pem"
}

key ca.key
openssl req -x509 -new -key ca.key -subj "/CN=coop run authority" -days "$days" -sha256 \
    -addext keyUsage=critical,keyCertSign -out ca.pem
certificate learner service "extendedKeyUsage=serverAuth,clientAuth\nsubjectAltName=${names#,}"
certificate replay service "extendedKeyUsage=serverAuth,clientAuth\nsubjectAltName=${names#,}"
certificate actor actor "extendedKeyUsage=clientAuth" # can't pass for a learner or a replay service
certificate evaluator actor "extendedKeyUsage=clientAuth"
echo "$folder: learner.json5, replay.json5, actor.json5 and evaluator.json5 for --zenoh-config, good for $days days; ca.key signs more"
