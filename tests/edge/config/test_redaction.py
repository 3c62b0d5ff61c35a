# SPDX-License-Identifier: Apache-2.0
import msgspec

from edge.config import Config
from edge.config.redaction import LEFT_OUT, without_secrets


def test_secrets_and_where_they_lie_are_left_out_and_nothing_else() -> None:
    curve = {"secret_key": "/etc/mapvo/device.key", "clients": "/etc/mapvo/clients"}
    config = msgspec.convert({"outputs": {"zmq": {"curve": curve}}}, Config)
    shown = without_secrets(config)
    assert shown["outputs"]["zmq"]["curve"]["secret_key"] == LEFT_OUT
    assert shown["outputs"]["zmq"]["curve"]["clients"] == "/etc/mapvo/clients"
    plain = msgspec.to_builtins(config)
    # Keyframes are no keys.
    assert shown["odometry"] == plain["odometry"]
    assert shown["runtime"] == plain["runtime"]


def test_what_is_not_set_is_shown_as_that() -> None:
    assert without_secrets(Config())["outputs"]["zmq"]["curve"]["secret_key"] == ""
