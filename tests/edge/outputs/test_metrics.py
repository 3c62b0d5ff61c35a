# SPDX-License-Identifier: Apache-2.0
import select
import socket
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import pytest

from edge.config.outputs import MetricsConfig
from edge.errors import OutputError
from edge.outputs import metrics
from edge.outputs.metrics import MetricsServer
from edge.outputs.status import Facts, StatusTally
from edge.types import LineSearch
from tests.edge.outputs import reports


def values(text: str) -> dict[str, float]:
    pairs = (line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    return {name: float(value) for name, value in pairs}


def test_counts_are_those_of_the_frames() -> None:
    tally = StatusTally(0)
    for latency in (4.0, 15.0, 15.0, 900.0):
        report = reports.report(1, fixes=(reports.fix(1), reports.fix(1, accepted=False)))
        tally.add(replace(report, timing=report.timing._replace(latency=latency)), 1)
    tally.add(reports.lost(2), 2)
    facts = Facts(level=2, temperature_c=71.5, refused_clients=3, camera="silent")
    found = values(metrics.render(tally, tally.message(0, 3, facts)))
    assert found["mapvo_frames_total"] == 5
    assert found["mapvo_frames_published_total"] == found["mapvo_frames_tracked_total"] == 4
    assert (found["mapvo_fixes_tried_total"], found["mapvo_fixes_accepted_total"]) == (8, 4)
    assert found["mapvo_temperature_celsius"] == 71.5
    assert (found["mapvo_ladder_level"], found["mapvo_camera_ok"]) == (2, 0)
    assert found["mapvo_clients_refused_total"] == 3
    assert found['mapvo_latency_seconds_bucket{le="0.01"}'] == 2
    assert found['mapvo_latency_seconds_bucket{le="0.02"}'] == 4
    assert found['mapvo_latency_seconds_bucket{le="+Inf"}'] == 5
    assert found["mapvo_latency_seconds_count"] == 5
    assert found["mapvo_latency_seconds_sum"] == pytest.approx(0.934)


def test_line_work_is_summed_over_all_its_ends() -> None:
    report = reports.report(1, fixes=(reports.fix(1),), with_keyframe=True)
    assert report.update.keyframe is not None
    keyframe = replace(report.update.keyframe, line_searches=(LineSearch(20, 300.0),))
    update = replace(report.update, keyframe=keyframe, line_searches=(LineSearch(5, 100.0),))
    told = replace(report.fixes[0].fix, line_searches=(LineSearch(100, 600.0),))
    tally = StatusTally(0)
    tally.add(replace(report, update=update, fixes=(replace(report.fixes[0], fix=told),)), 1)
    tally.add(reports.lost(2), 2)
    found = values(metrics.render(tally, None))
    assert (found["mapvo_line_searches_total"], found["mapvo_lines_seen_total"]) == (3, 125)
    assert found["mapvo_line_seconds_total"] == pytest.approx(1.0)


def test_every_figure_is_explained() -> None:
    tally = StatusTally(0)
    text = metrics.render(tally, tally.message(0, 1, Facts()))
    for name in {name.split("{")[0] for name in values(text)}:
        base = name.removesuffix("_bucket").removesuffix("_sum").removesuffix("_count")
        assert f"# HELP {base} " in text
        assert f"# TYPE {base} " in text


@pytest.fixture
def server() -> Iterator[MetricsServer]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with closing(MetricsServer(MetricsConfig(port=port), lambda: "mapvo_up 1\n")) as server:
        yield server


def serve(server: MetricsServer) -> None:
    ready = select.select([server.listener, *server.connections], [], [], 0.01)[0]
    for item in ready:
        if item is server.listener:
            server.accept()
        else:
            server.answer(item)


def test_text_is_served_and_other_paths_are_not(server: MetricsServer) -> None:
    def get(path: str) -> tuple[int, str]:
        url = f"http://127.0.0.1:{server.port}{path}"
        try:
            with urllib.request.urlopen(url) as reply:
                return reply.status, reply.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, ""

    with ThreadPoolExecutor(1) as pool:
        for path, expected in (("/metrics", (200, "mapvo_up 1\n")), ("/etc", (404, ""))):
            answer = pool.submit(get, path)
            while not answer.done():
                serve(server)
            assert answer.result() == expected


def test_idle_and_vanishing_clients_do_not_pile_up(server: MetricsServer) -> None:
    address = ("127.0.0.1", server.port)
    idle = [socket.create_connection(address) for _ in range(50)]
    for _ in range(60):
        serve(server)
    assert 0 < len(server.connections) <= 8
    for connection in idle:
        connection.close()
    for _ in range(20):
        serve(server)
    assert server.connections == []


def test_port_in_use_is_one_line(server: MetricsServer) -> None:
    with pytest.raises(OutputError, match=r"outputs\.metrics\.port \d+: .*0 for none$"):
        MetricsServer(MetricsConfig(port=server.port), lambda: "")
