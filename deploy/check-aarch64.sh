#!/bin/sh
# Every dependency of the device has a wheel for 64-bit Arm (manylinux_2_28): says so, or fails.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$here/make-wheelhouse.sh" "$folder" aarch64
find "$folder" -name '*.whl' -exec basename {} \; | sort
