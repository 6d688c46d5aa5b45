#!/bin/bash
# Makes the folder of an image to build in: BASE and DIR are arguments, standard input is what `pip config list` prints.
# Only what says where packages come from goes into it. Files that the configuration names, which the image lacks, come along at the same place (certificates,
# folders of wheels) or are left out: indexes on this machine's disk, and constraints, for the build has a file of its own.
set -eu
base=$1 folder=$2
mkdir -p "$folder/root/etc/ssl/certs"
settings() { # NAMES: the last value of each, as pip takes them: environment over a command's section over global
    sed -nE "s/^(global|install|:env:)\.($1)='(.*)'\$/\1 \2 \3/p" "$folder/settings" | sed 's/\\n/ /g' \
        | sort -s -k2,2 -k1,1 | awk '{ rank = $1 == "global" ? 0 : $1 == "install" ? 1 : 2 }
            rank >= had[$2] { had[$2] = rank; name = $2; $1 = $2 = ""; sub(/^ +/, ""); value[name] = $0 }
            END { for (name in value) print name " = " value[name] }' | sort
}
cat > "$folder/settings"
certificates=$(settings cert | sed 's/^cert = //')
cp "${certificates:-/etc/ssl/certs/ca-certificates.crt}" "$folder/root/etc/ssl/certs/ca-certificates.crt"
{
    echo "[global]"
    [ -z "$certificates" ] || echo "cert = /etc/ssl/certs/ca-certificates.crt"
    settings "trusted-host|no-index|proxy|timeout|default-timeout|retries"
    settings "index-url|extra-index-url|find-links" | while read -r name _ places; do
        there=
        for place in $places; do
            case $place in
                *://*) [[ $place == file:* ]] || there+=" $place" ;;
                *) if [ -d "$place" ]; then mkdir -p "$folder/root$place" && cp "$place"/* "$folder/root$place/" && there+=" $place"; fi ;;
            esac
        done
        [ -z "$there" ] || echo "$name =$there"
    done
} > "$folder/root/etc/pip.conf"
rm "$folder/settings"
printf '%s\n' "FROM $base" "COPY root /" > "$folder/Dockerfile"
