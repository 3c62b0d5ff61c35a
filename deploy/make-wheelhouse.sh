#!/bin/sh
# Makes a folder of wheels for an installation without a network: make-wheelhouse.sh DIR [ARCH]
# ARCH is aarch64 or x86_64 (default: this machine's); Python is that of Debian 12 unless
# MAPVO_PYTHON says otherwise (3.11, 3.12, 3.13). MAPVO_EXTRAS=oak takes in what Luxonis needs.
set -eu
cd "$(dirname "$0")/.."
out=${1:?usage: make-wheelhouse.sh DIR [aarch64|x86_64]}
arch=${2:-$(uname -m)}
python=${MAPVO_PYTHON:-3.11}
pip="${MAPVO_PIP:-python3 -m pip} --quiet --disable-pip-version-check"
mkdir -p "$out"
rm -rf build/lib build/bdist.* # setuptools would pack files that are long gone
# shellcheck disable=SC2086  # a command with its arguments
$pip wheel --no-deps --wheel-dir "$out" .
# shellcheck disable=SC2086
$pip download --dest "$out" --only-binary=:all: --implementation cp --python-version "$python" \
    --platform "manylinux_2_28_$arch" --platform "manylinux_2_27_$arch" \
    --platform "manylinux_2_24_$arch" --platform "manylinux_2_17_$arch" \
    --platform "manylinux2014_$arch" --platform "linux_$arch" --find-links "$out" \
    "mapvo${MAPVO_EXTRAS:+[$MAPVO_EXTRAS]}"
printf '%s: %s wheels for %s, Python %s\n' "$out" "$(find "$out" -name '*.whl' | wc -l)" "$arch" "$python"
