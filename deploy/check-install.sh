#!/bin/sh
# Installs into a fresh Debian, updates, fails to update, returns, takes away; says so, or fails.
#
#   check-install.sh WHEELHOUSE [ROOT]
#
# ROOT is a debootstrap of Debian with python3, python3-venv, udev and systemd; without it one is
# made, which takes root, debootstrap and the Debian mirror.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
wheels=${1:?usage: check-install.sh WHEELHOUSE [ROOT]}
root=${2:-}
[ "$(id -u)" = 0 ] || { echo "check-install: needs root" >&2; exit 2; }
if [ -z "$root" ]; then
    command -v debootstrap >/dev/null || { echo "check-install: needs debootstrap" >&2; exit 2; }
    root=$(mktemp -d)
    debootstrap --variant=minbase --include=python3,python3-venv,systemd,udev,dbus bookworm "$root"
fi

inside() { chroot "$root" env -i PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin HOME=/root "$@"; }
check() { "$@" || { echo "check-install: failed: $*" >&2; exit 1; }; }
refuse() { if "$@"; then echo "check-install: should have failed: $*" >&2; exit 1; fi; }

rm -rf "$root/root/mapvo"
mkdir -p "$root/root/mapvo/pictures"
cp "$here"/*.sh "$here"/*.md "$here"/mapvo.toml "$here"/mapvo.command "$here"/network.conf "$here"/../systemd/* "$root/root/mapvo/"
cp "$here"/pictures/* "$root/root/mapvo/pictures/"
cp -r "$wheels" "$root/root/mapvo/wheelhouse"
mount -t proc proc "$root/proc"
trap 'umount "$root/proc"' EXIT

echo "== install, offline"
check inside sh /root/mapvo/install.sh
first=$(inside readlink /opt/mapvo/current)
check inside mapvo --version
check inside mapvo check-config /etc/mapvo/mapvo.toml
check inside mapvo tiles list
echo "== the doctor, in a chroot without camera or daemon: it has to speak, not to be content"
inside mapvo doctor --config /etc/mapvo/mapvo.toml || true

echo "== update"
check inside sh /root/mapvo/install.sh
second=$(inside readlink /opt/mapvo/current)
check test "$first" != "$second"
check test "$(inside readlink /opt/mapvo/previous)" = "$first"

echo "== an update that does not accept the settings changes nothing"
echo 'nonsense = 1' >>"$root/etc/mapvo/mapvo.toml"
refuse inside sh /root/mapvo/install.sh
check test "$(inside readlink /opt/mapvo/current)" = "$second"
check test "$(find "$root/opt/mapvo/versions" -mindepth 1 -maxdepth 1 | wc -l)" = 2
sed -i '/^nonsense/d' "$root/etc/mapvo/mapvo.toml"

echo "== a wheelhouse that lacks a wheel changes nothing"
mkdir "$root/root/empty"
refuse inside sh /root/mapvo/install.sh --wheelhouse /root/empty
check test "$(inside readlink /opt/mapvo/current)" = "$second"

echo "== back, with the unit of then"
echo '# of the first version' >>"$root$first/units/mapvo.service"
check inside sh /opt/mapvo/share/install.sh --back
check test "$(inside readlink /opt/mapvo/current)" = "$first"
check grep -q 'of the first version' "$root/etc/systemd/system/mapvo.service"
check inside mapvo --version

echo "== away"
check inside sh /root/mapvo/install.sh --uninstall
check test ! -e "$root/opt/mapvo"
check test -e "$root/etc/mapvo/mapvo.toml"
check test -d "$root/var/lib/mapvo/store/inbox"
check inside sh /root/mapvo/install.sh --purge
check test ! -e "$root/etc/mapvo"
check test ! -e "$root/var/lib/mapvo"
refuse inside id mapvo
echo "check-install: all good"
