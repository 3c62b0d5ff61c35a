# SPDX-License-Identifier: Apache-2.0
"""The doctor on the map and on where poses go."""

from pathlib import Path

from edge.config import Config
from edge.config.outputs import CurveConfig
from edge.config.serial import SerialConfig, loads
from edge.errors import EdgeError
from edge.outputs.serial_output import make_stream
from edge.runtime.doctor_host import Finding, Host, bad, doubtful, good
from edge.runtime.doctor_models import check_models
from edge.store.layout import Layout
from edge.tiles.manifest import Manifest
from edge.tiles.reader import open_map

_BITS_PER_BYTE = 10
_TIGHT = 0.6  # of a line: above it, late messages pile up now and then


def check_map_and_outputs(host: Host, config: Config) -> list[Finding]:
    """The map and the models that go with it, the serial line, and the keys."""
    findings, manifest = _map(host, config)
    return [
        *findings,
        *check_models(host, config, manifest),
        *_serial(host, config.outputs.serial, manifest),
        *_keys(host, config.outputs.zmq.curve),
    ]


def _map(host: Host, config: Config) -> tuple[list[Finding], Manifest | None]:
    if config.map.folder:
        name, folder = config.map.folder, host.path(config.map.folder)
        cure = "copy it anew, or build it again"
    elif config.tiles.store:
        store = Layout(host.path(config.tiles.store))
        if (number := store.linked("current")) is not None:
            try:
                folder = store.map_folder(store.generation(number))
            except EdgeError as error:
                return [bad("map", str(error), "install another bundle")], None
            name = f"{config.tiles.store}: {folder.name}"
            return _look_at_map(name, folder, "`mapvo tiles install` it again")
        remedy = "`mapvo tiles install FILE`, or put a bundle into its inbox"
        return [doubtful("map", f"{config.tiles.store} holds none yet", remedy)], None
    else:
        remedy = "set map.folder or tiles.store; without one there are no map poses"
        return [doubtful("map", "none is configured", remedy)], None
    return _look_at_map(name, folder, cure)


def _look_at_map(name: str, folder: Path, cure: str) -> tuple[list[Finding], Manifest | None]:
    try:
        map_ = open_map(folder, verify=True)
    except EdgeError as error:
        return [bad("map", str(error), cure)], None
    counts = f"{map_.n_keyframes} keyframes, {len(map_.tiles)} tiles"
    findings = [good("map", f"{name}: {counts}, every byte checked")]
    if not map_.manifest.metric:
        remedy = "build it with a metric scale, or `mapvo-map align` it"
        findings.append(doubtful("map", "its lengths are no metres", remedy))
    return findings, map_.manifest


def _serial(host: Host, config: SerialConfig, manifest: Manifest | None) -> list[Finding]:
    if not config.device:
        return []
    findings = [_budget(config)]
    device = host.path(config.device)
    if not device.exists():
        there = ", ".join(path.name for path in host.glob("/dev/serial/by-id/*")) or "none"
        remedy = f"plug it in, or name one of /dev/serial/by-id/: {there}"
        findings.append(bad("serial", f"{config.device} is not there", remedy))
    elif refusal := host.refusal(device.resolve()):
        findings.append(bad("serial", f"{config.device} may not be opened", refusal))
    else:
        findings.append(good("serial", config.device))
    if "ModemManager" in host.processes():
        remedy = "sudo systemctl disable --now ModemManager, or a udev rule ID_MM_DEVICE_IGNORE"
        findings.append(doubtful("serial", "ModemManager sends its own bytes", remedy))
    if manifest is not None:
        try:
            make_stream(
                config,
                metric=manifest.metric,
                T_local_map=manifest.T_local_map,
                map_name="the map",
            )
        except EdgeError as error:
            findings.append(bad("serial", str(error), "`mapvo-map align`"))
    return findings


def _budget(config: SerialConfig) -> Finding:
    wanted = loads(config)
    total = sum(load.size_bytes * load.rate_hz for load in wanted)
    share = total / (config.baud / _BITS_PER_BYTE)
    terms = " + ".join(f"{x.name} {x.size_bytes} x {x.rate_hz:g} Hz" for x in wanted)
    found = f"{terms}: {share:.0%} of {config.baud} baud"
    if share > _TIGHT:
        remedy = "raise outputs.serial.baud, or lower rate_hz"
        return doubtful("serial budget", found, remedy)
    return good("serial budget", found)


def _keys(host: Host, config: CurveConfig) -> list[Finding]:
    if not config.secret_key:
        return []
    path: Path = host.path(config.secret_key)
    if not path.is_file():
        return [bad("keys", f"{config.secret_key} is missing", "`mapvo client-key` makes a pair")]
    if path.stat().st_mode & 0o077:
        remedy = f"chmod 600 {config.secret_key}"
        return [bad("keys", f"{config.secret_key} can be read by others", remedy)]
    return [good("keys", f"{config.secret_key} is this account's alone")]
