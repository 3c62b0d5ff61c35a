#!/bin/sh
# Installs mapvo on a Debian-like system, updates it, or takes it away. Safe to repeat.
#
#   install.sh [--wheelhouse DIR]   install or update; from the wheels in DIR alone, if given
#   install.sh --back               return to the version before
#   install.sh --uninstall          take the program away; maps and settings stay
#   install.sh --purge              take everything away
#
# MAPVO_PYTHON=3.11 (3.12, 3.13) takes that Python where the system's own is older.
#
# Each version has a folder of its own below /opt/mapvo/versions; `current` is a link. A new version
# has to start, compile its kernels and accept the settings before the link moves, and the service
# has to become ready after that: else the old version comes back, and its unit with it.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
opt=/opt/mapvo
etc=/etc/mapvo
state=/var/lib/mapvo
cache=/var/cache/mapvo
python=python${MAPVO_PYTHON:-3}
units=/etc/systemd/system
wheelhouse=
if [ -d "$here/wheelhouse" ]; then wheelhouse=$here/wheelhouse; fi

say() { printf 'mapvo install: %s\n' "$*"; }
fail() {
    printf 'mapvo install: %s\n' "$*" >&2
    exit 2
}

has_systemd() { [ -d /run/systemd/system ]; }

as_mapvo() {
    setpriv --reuid=mapvo --regid=mapvo --init-groups env HOME="$state" XDG_CACHE_HOME="$cache" \
        OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 "$@"
}

# Files of the installer lie beside it (a package, a copy), or in the source tree.
source_of() {
    for folder in "$here" "$here/../systemd"; do
        if [ -f "$folder/$1" ]; then
            printf '%s\n' "$folder/$1"
            return
        fi
    done
    fail "$1 is missing beside $here/install.sh; copy the whole folder"
}

check_system() {
    [ "$(id -u)" = 0 ] || fail "run it as root: sudo $0"
    command -v "$python" >/dev/null || fail "$python is missing: apt install $python $python-venv"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "$python is $("$python" -V | cut -d' ' -f2), mapvo needs 3.11 or newer: apt install python3.11 python3.11-venv, then sudo MAPVO_PYTHON=3.11 $0"
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        fail "$python lacks its venv module: apt install $python-venv"
    if [ -n "$wheelhouse" ]; then
        [ -d "$wheelhouse" ] || fail "$wheelhouse is no folder of wheels; make one with make-wheelhouse.sh"
        wheelhouse=$(cd "$wheelhouse" && pwd)
    fi
}

make_user() {
    if command -v systemd-sysusers >/dev/null; then
        install -D -m 644 "$(source_of mapvo.sysusers)" /usr/lib/sysusers.d/mapvo.conf
        systemd-sysusers /usr/lib/sysusers.d/mapvo.conf
    elif ! id mapvo >/dev/null 2>&1; then
        useradd --system --user-group --home-dir "$state" --shell /usr/sbin/nologin mapvo
        for group in video dialout; do
            if getent group "$group" >/dev/null; then usermod -aG "$group" mapvo; fi
        done
    fi
}

make_folders() {
    install -d -m 755 "$opt/versions" "$opt/share" "$etc" "$etc/keys"
    install -d -m 750 -o mapvo -g mapvo "$state" "$state/store" "$state/recordings"
    install -d -m 2770 -o mapvo -g mapvo "$state/store/inbox"
    install -d -m 755 -o mapvo -g mapvo "$cache"
    if [ ! -e "$etc/mapvo.toml" ]; then
        install -m 644 "$(source_of mapvo.toml)" "$etc/mapvo.toml"
    fi
}

# Prints the folder of a new version, which nothing uses yet.
make_version() {
    folder=$opt/versions/$(date -u +%Y%m%d-%H%M%S)
    "$python" -m venv "$folder" >&2 || fail "$python could not make $folder"
    set -- --quiet --disable-pip-version-check --no-cache-dir
    if [ -n "$wheelhouse" ]; then
        set -- "$@" --no-index --find-links "$wheelhouse" mapvo
    else
        [ -f "$here/../pyproject.toml" ] || fail "no wheels here: give --wheelhouse DIR"
        # A copy: root leaves nothing in the user's tree, and what was built there once stays out.
        source=$folder/source
        mkdir "$source"
        for part in pyproject.toml README.md LICENSE edge maps; do cp -r "$here/../$part" "$source/"; done
        set -- "$@" "$source"
    fi
    if "$folder/bin/python" -m pip install "$@" >&2; then
        rm -rf "$folder/source"
    else
        rm -rf "$folder"
        fail "pip could not install mapvo; its reason stands above, and nothing has changed"
    fi
    printf '%s\n' "$folder"
}

# What can be known before the service is touched.
try_version() {
    "$1/bin/mapvo" --version || return 1
    as_mapvo "$1/bin/mapvo" check-config "$etc/mapvo.toml" || return 1
    say "compiling kernels (minutes on a small machine, once a version) ..."
    as_mapvo "$1/bin/mapvo" warm-up --config "$etc/mapvo.toml" || return 1
}

point() { # atomically
    ln -sfn "$2" "$1.new"
    sync -f "$opt"
    mv -T "$1.new" "$1"
    sync -f "$opt"
}

# What the system itself needs of a version lies with it, so that the way back finds it.
keep_units() {
    install -d -m 755 "$1/units"
    for file in mapvo.command mapvo.service mapvo.tmpfiles 60-mapvo.rules; do
        install -m 644 "$(source_of "$file")" "$1/units/$file"
    done
}

install_share() {
    for file in install.sh mapvo.command mapvo.toml mapvo.service mapvo.sysusers mapvo.tmpfiles 60-mapvo.rules \
        network.conf FIELD_GUIDE.md INTEGRATION.md; do
        if [ "$(source_of "$file")" != "$opt/share/$file" ]; then
            install -m 644 "$(source_of "$file")" "$opt/share/$file"
        fi
    done
    if [ -d "$here/pictures" ] && [ "$here" != "$opt/share" ]; then
        install -d -m 755 "$opt/share/pictures"
        install -m 644 "$here"/pictures/* "$opt/share/pictures/"
    fi
}

install_units() {
    [ -d "$1/units" ] || return 0 # it is from before they were kept: what is there has to do
    rm -f /usr/local/bin/mapvo
    install -m 755 "$1/units/mapvo.command" /usr/local/bin/mapvo
    install -D -m 644 "$1/units/mapvo.service" "$units/mapvo.service"
    install -D -m 644 "$1/units/mapvo.tmpfiles" /usr/lib/tmpfiles.d/mapvo.conf
    install -D -m 644 "$1/units/60-mapvo.rules" /usr/lib/udev/rules.d/60-mapvo.rules
    if has_systemd; then
        systemctl daemon-reload
        systemctl --quiet enable mapvo.service
        systemd-tmpfiles --create /usr/lib/tmpfiles.d/mapvo.conf
        if command -v udevadm >/dev/null; then
            udevadm control --reload || say "udev did not take the rules; plug devices in again"
        fi
    fi
}

# Restarts the service if it ran; type notify makes systemctl wait until it is ready.
restart_if_running() {
    has_systemd || return 0
    systemctl --quiet is-active mapvo.service || return 0
    say "waiting for the new version to become ready ..."
    systemctl restart mapvo.service
}

switch_to() {
    old=$(readlink "$opt/current" || true)
    install_units "$1"
    point "$opt/current" "$1"
    if ! restart_if_running; then
        [ -n "$old" ] || fail "the service does not become ready: journalctl -u mapvo"
        install_units "$old"
        point "$opt/current" "$old"
        systemctl restart mapvo.service || true
        fail "the new version did not become ready (journalctl -u mapvo): returned to $old"
    fi
    if [ -n "$old" ] && [ "$old" != "$1" ]; then point "$opt/previous" "$old"; fi
}

drop_old_versions() {
    for folder in "$opt"/versions/*; do
        case $folder in
        "$(readlink "$opt/current")" | "$(readlink "$opt/previous" || true)") ;;
        *) rm -rf "$folder" ;;
        esac
    done
}

do_install() {
    check_system
    make_user
    make_folders
    version=$(make_version)
    if ! try_version "$version"; then
        rm -rf "$version"
        fail "the new version does not work here; its reason stands above, and nothing has changed"
    fi
    keep_units "$version"
    install_share
    switch_to "$version"
    drop_old_versions
    say "$("$opt/current/bin/mapvo" --version) is in $version"
    if [ ! -e "$opt/previous" ]; then
        say "next: a calibration in $etc/camera.toml, a key in $etc/keys, mapvo doctor, then: systemctl start mapvo"
    fi
}

do_back() {
    [ "$(id -u)" = 0 ] || fail "run it as root: sudo $0 --back"
    [ -d "$opt/previous/bin" ] || fail "there is no version before this one"
    switch_to "$(readlink "$opt/previous")"
    say "returned to $(readlink "$opt/current")"
}

do_uninstall() {
    [ "$(id -u)" = 0 ] || fail "run it as root: sudo $0 $1"
    if has_systemd && [ -e "$units/mapvo.service" ]; then
        systemctl --quiet disable --now mapvo.service || true
    fi
    rm -f "$units/mapvo.service" /usr/lib/tmpfiles.d/mapvo.conf \
        /usr/lib/udev/rules.d/60-mapvo.rules /usr/local/bin/mapvo
    rm -rf "$opt" "$cache"
    if has_systemd; then systemctl daemon-reload; fi
    if [ "$1" = --purge ]; then
        rm -rf "$etc" "$state" "$units/mapvo.service.d" /usr/lib/sysusers.d/mapvo.conf
        if id mapvo >/dev/null 2>&1; then userdel mapvo; fi
        say "taken away, with its settings and maps"
    else
        say "taken away; settings stay in $etc, maps in $state"
    fi
}

action=install
while [ $# -gt 0 ]; do
    case $1 in
    --wheelhouse)
        [ $# -gt 1 ] || fail "--wheelhouse needs a folder"
        wheelhouse=$2
        shift
        ;;
    --back) action=back ;;
    --uninstall | --purge) action=$1 ;;
    *) fail "unknown: $1; see the first lines of $0" ;;
    esac
    shift
done
case $action in
install) do_install ;;
back) do_back ;;
*) do_uninstall "$action" ;;
esac
