# SPDX-License-Identifier: Apache-2.0
"""The doctor on the machine: clock, processor, heat, supply, memory, disk, compiled kernels."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from edge.config import Config
from edge.outputs.capture_ring import room_bytes
from edge.runtime.doctor_host import Finding, Host, bad, doubtful, good
from edge.runtime.kernel_cache import find_kernel_cache
from edge.runtime.supply import Supply
from edge.runtime.thermometer import Thermometer

_BUILT = time.strptime("2026-01-01", "%Y-%m-%d")
_MB = 1e6
_LEAST_MEMORY_MB, _GOOD_MEMORY_MB = 300.0, 600.0
_LEAST_ROOM_MB, _GOOD_ROOM_MB = 100.0, 1000.0
_MIN_KERNELS = 40  # far fewer than there are; a cache that was begun and given up has less


def check_system(
    host: Host, config: Config, room: Callable[[Path], int] = room_bytes
) -> list[Finding]:
    """Everything about the machine."""
    return [
        *_clock(host),
        *_processor(host),
        *_heat(host, config),
        *_supply(host),
        *_memory(host),
        *_disk(host, config, room),
        _kernels(),
    ]


def _clock(host: Host) -> list[Finding]:
    findings = []
    if time.gmtime() < _BUILT:
        remedy = "set it, or connect once to a network; expired and not yet valid maps are mixed up"
        findings.append(bad("clock", time.strftime("%Y-%m-%d", time.gmtime()), remedy))
    synchronised = [
        name
        for name in ("/run/systemd/timesync/synchronized", "/run/chrony", "/run/ntpd.pid")
        if host.path(name).exists()
    ]
    has_rtc = bool(host.glob("/sys/class/rtc/rtc*"))
    if synchronised:
        findings.append(good("clock", "kept by the network"))
    elif has_rtc:
        findings.append(good("clock", "not kept by the network, but it has a battery clock"))
    else:
        findings.append(
            doubtful(
                "clock",
                "neither network time nor a battery clock",
                "poses do not mind; enable systemd-timesyncd or chrony for logs and expiry dates",
            )
        )
    source = host.read("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source in ("hpet", "acpi_pm", "jiffies"):
        remedy = "boot with clocksource=tsc if the processor has it: reading time is slow"
        findings.append(doubtful("clock source", source, remedy))
    return findings


def _processor(host: Host) -> list[Finding]:
    cores = len(host.glob("/sys/devices/system/cpu/cpu[0-9]*"))
    # Of cores that are switched off, as in a Jetson's small power modes, it cannot be read.
    governors = set(host.texts("/sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    slow = sorted(governors - {"performance", "schedutil"})
    findings = []
    if cores == 1:
        remedy = "two and more are needed to relocalise beside tracking"
        findings.append(doubtful("processor", "1 core", remedy))
    if slow:
        remedy = "sudo cpupower frequency-set -g performance (or schedutil)"
        findings.append(doubtful("governor", ", ".join(slow), remedy))
    elif governors:
        findings.append(good("governor", ", ".join(sorted(governors))))
    return findings


def _heat(host: Host, config: Config) -> list[Finding]:
    celsius = Thermometer(host.path("/sys/class/thermal")).celsius()
    if celsius is None:
        return []
    found = f"{celsius:.0f} degrees C"
    if celsius >= config.runtime.ladder.hot_c:
        remedy = "cool it: a heat sink, a fan, shade; until then it runs at less than full quality"
        return [bad("temperature", found, remedy)]
    if celsius >= config.runtime.ladder.cool_c:
        return [doubtful("temperature", found, "give it air before the load grows")]
    return [good("temperature", found)]


def _supply(host: Host) -> list[Finding]:
    remedy = "use the supply that is made for the board, a short thick cable, powered hubs"
    report = Supply(host.root).read()
    if report is None:
        return []
    if report.low:
        return [bad("supply", "under-voltage now", remedy)]
    if report.was_low:
        return [doubtful("supply", "under-voltage since boot", remedy)]
    if report.was_slowed:
        return [doubtful("supply", "the processor was slowed down since boot", "cool it")]
    return [good("supply", "no under-voltage")]


def _memory(host: Host) -> list[Finding]:
    for line in (host.read("/proc/meminfo") or "").splitlines():
        if line.startswith("MemAvailable:"):
            free_mb = int(line.split()[1]) * 1024 / _MB
            found = f"{free_mb:.0f} MB available"
            if free_mb < _LEAST_MEMORY_MB:
                return [bad("memory", found, "end other programs; some 300 MB are needed")]
            if free_mb < _GOOD_MEMORY_MB:
                return [doubtful("memory", found, "end other programs, or add swap (zram)")]
            return [good("memory", found)]
    return []


def _disk(host: Host, config: Config, room: Callable[[Path], int]) -> list[Finding]:
    places = {"disk": "/"}
    if config.recorder.folder:
        places["recorder"] = config.recorder.folder
    if config.tiles.store:
        places["tile store"] = config.tiles.store
    findings = []
    for subject, name in places.items():
        folder = _existing(host.path(name))
        free_mb = room(folder) / _MB
        needed_mb = _LEAST_ROOM_MB
        if subject == "recorder":
            needed_mb = config.recorder.min_free_mb
        found = f"{free_mb:.0f} MB free at {name}"
        if subject != "disk" and not os.access(folder, os.W_OK):
            remedy = f"give it to {host.account.name}, or name another folder"
            findings.append(bad(subject, f"{name} cannot be written", remedy))
        elif free_mb < needed_mb:
            findings.append(bad(subject, found, f"make room: {needed_mb:.0f} MB are needed"))
        elif free_mb < _GOOD_ROOM_MB:
            findings.append(doubtful(subject, found, "make room before it is needed"))
        else:
            findings.append(good(subject, found))
    return findings


def _existing(folder: Path) -> Path:
    while not folder.exists():
        folder = folder.parent
    return folder


def _kernels() -> Finding:
    folder = find_kernel_cache()
    count = sum(1 for _ in folder.glob("**/*.nbi")) if folder.is_dir() else 0
    if count < _MIN_KERNELS:
        found = f"{count} compiled kernels in {folder}"
        return doubtful("kernels", found, "`mapvo warm-up`, else the first start takes a minute")
    return good("kernels", f"{count} in {folder}")
