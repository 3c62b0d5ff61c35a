#!/bin/sh
# The unit is sound (systemd-analyze verify prints nothing) and tight (exposure at most 2.0).
set -eu
here=$(cd "$(dirname "$0")/../systemd" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# What it starts need not be installed here.
sed 's|/opt/mapvo/current/bin/mapvo|/bin/true|' "$here/mapvo.service" >"$folder/mapvo.service"
said=$(systemd-analyze verify --man=no "$folder/mapvo.service" 2>&1)
if [ -n "$said" ]; then
    printf 'mapvo.service: %s\n' "$said" >&2
    exit 1
fi
said=$(systemd-analyze security --offline=true --no-pager --threshold=20 "$folder/mapvo.service") || {
    printf '%s\n' "$said" >&2
    exit 1
}
printf '%s\n' "$said" | tail -n 1
