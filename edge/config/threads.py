# SPDX-License-Identifier: Apache-2.0
"""Which cores and what priority each thread of the daemon has."""

from typing import Annotated

from msgspec import Meta, Struct

_Nice = Annotated[int, Meta(ge=-20, le=19)]
Cpus = tuple[Annotated[int, Meta(ge=0, le=1023)], ...]


class ThreadsConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Empty lists of cores mean any; nice is added to the process's own, but for `changes_nice`.

    Below 0 it needs the right to it (CAP_SYS_NICE, or LimitNICE= of systemd).
    """

    # The pose depends on it.
    tracking_cpus: Cpus = ()
    tracking_nice: _Nice = 0
    # Frames must not wait to be fetched.
    camera_cpus: Cpus = ()
    camera_nice: _Nice = 0
    # The window and the relocaliser may take longer without harm; they hold the interpreter now
    # and then, so that too low a priority would make the tracking wait for them.
    keyframes_cpus: Cpus = ()
    keyframes_nice: _Nice = 0
    relocalise_cpus: Cpus = ()
    relocalise_nice: _Nice = 5
    # What looks for changes is a process of its own, of just this nice; nobody waits for it.
    changes_cpus: Cpus = ()
    changes_nice: _Nice = 15
    # Serial line, control socket and metrics.
    others_nice: _Nice = 5
    # How long a thread may hold the interpreter while another wants it [us]; Python's own 5000
    # would make tracking wait several milliseconds after each kernel.
    switch_interval_us: Annotated[int, Meta(ge=10, le=100_000)] = 200
