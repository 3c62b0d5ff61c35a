#!/bin/sh
# Makes a Debian package that installs without a network: build-deb.sh WHEELHOUSE OUT [ARCH]
# ARCH is amd64 or arm64 (default: this machine's), that of the wheels.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
wheels=${1:?usage: build-deb.sh WHEELHOUSE OUT [amd64|arm64]}
out=${2:?usage: build-deb.sh WHEELHOUSE OUT [amd64|arm64]}
arch=${3:-$(dpkg --print-architecture)}
wheel=$(find "$wheels" -name 'mapvo-*.whl')
[ "$(printf '%s\n' "$wheel" | grep -c .)" = 1 ] || { echo "build-deb: $wheels has not one wheel of mapvo" >&2; exit 2; }
version=$(basename "$wheel" | cut -d- -f2)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
share=$folder/usr/share/mapvo
mkdir -p "$folder/DEBIAN" "$share/wheelhouse" "$share/pictures" "$folder/usr/share/doc/mapvo"
install -m 644 "$wheels"/*.whl "$share/wheelhouse/"
install -m 755 "$here/install.sh" "$share/"
install -m 644 "$here"/*.md "$here/mapvo.toml" "$here/mapvo.command" "$here/network.conf" "$here"/../systemd/* "$share/"
install -m 644 "$here"/pictures/* "$share/pictures/"
install -m 644 "$here/../LICENSE" "$folder/usr/share/doc/mapvo/copyright"
cat >"$folder/DEBIAN/control" <<END
Package: mapvo
Version: $version
Architecture: $arch
Maintainer: mapvo <maintainers@mapvo.invalid>
Depends: python3 (>= 3.11), python3-venv, adduser | systemd
Recommends: systemd, udev
Installed-Size: $(du -sk "$folder/usr" | cut -f1)
Section: science
Priority: optional
Description: tells a moving camera where it is on a map
 One camera on a small Linux computer knows where it is on a map made
 beforehand: in every frame, at the map's scale.
END
cat >"$folder/DEBIAN/postinst" <<'END'
#!/bin/sh
set -e
if [ "$1" = configure ]; then sh /usr/share/mapvo/install.sh; fi
END
cat >"$folder/DEBIAN/prerm" <<'END'
#!/bin/sh
set -e
if [ "$1" = remove ]; then sh /usr/share/mapvo/install.sh --uninstall; fi
END
cat >"$folder/DEBIAN/postrm" <<'END'
#!/bin/sh
set -e
if [ "$1" = purge ]; then
    rm -rf /etc/mapvo /var/lib/mapvo /usr/lib/sysusers.d/mapvo.conf
    if id mapvo >/dev/null 2>&1; then userdel mapvo; fi
fi
END
chmod 755 "$folder/DEBIAN/postinst" "$folder/DEBIAN/prerm" "$folder/DEBIAN/postrm"
# Wheels are compressed already.
dpkg-deb --root-owner-group -Znone --build "$folder" "$out"
