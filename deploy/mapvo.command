#!/bin/sh
# The command mapvo of this device. What looks after the daemon runs as the daemon's user, with its
# rights and its compiled kernels; all else runs as who calls it.
case ${1:-} in
doctor | warm-up)
    if [ "$(id -u)" = 0 ]; then
        exec setpriv --reuid=mapvo --regid=mapvo --init-groups env HOME=/var/lib/mapvo \
            XDG_CACHE_HOME=/var/cache/mapvo PYTHONDONTWRITEBYTECODE=1 /opt/mapvo/current/bin/mapvo "$@"
    fi
    ;;
esac
exec /opt/mapvo/current/bin/mapvo "$@"
