# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.config import Config, load_config
from edge.errors import ConfigError


def error_of(tmp_path: Path, text: str) -> str:
    file = tmp_path / "site.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(file))
    return message.removeprefix(str(file))


def test_no_file_gives_the_defaults() -> None:
    assert load_config(None) == Config()


def test_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("")
    assert load_config(tmp_path / "site.toml") == Config()


def test_named_keys_are_taken(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("[runtime]\nrelocalise_delay_frames = 7\n")
    assert load_config(tmp_path / "site.toml").runtime.relocalise_delay_frames == 7


def test_a_byte_order_mark_is_no_key(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("[runtime]\n", encoding="utf-8-sig")
    assert load_config(tmp_path / "site.toml") == Config()


def test_unknown_key_is_named_with_its_line_and_a_guess(tmp_path: Path) -> None:
    message = error_of(tmp_path, "# mine\n\n[runtime]\nrelocalise_delay_frame = 7\n")
    assert message.startswith(", line 4: unknown key runtime.relocalise_delay_frame; did you mean")
    assert "relocalise_delay_frames?" in message


def test_unknown_table_is_named_with_its_line(tmp_path: Path) -> None:
    message = error_of(tmp_path, "[runtime]\n[output.zmq]\n")
    assert message.startswith(", line 2: unknown key output; did you mean outputs?")


def test_wrong_type_is_named_with_its_line(tmp_path: Path) -> None:
    message = error_of(tmp_path, '[runtime]\nrelocalise_delay_frames = "7"\n')
    assert message.startswith(", line 2: runtime.relocalise_delay_frames: expected `int`")


def test_impossible_value_is_refused(tmp_path: Path) -> None:
    message = error_of(tmp_path, "[outputs]\nzmq.queue_messages = 0\n")
    assert message.startswith(", line 2: outputs.zmq.queue_messages: expected `int` >= 1")


@pytest.mark.parametrize("table", ["relocalise", "registration", "odometry"])
def test_no_number_may_be_wild(tmp_path: Path, table: str) -> None:
    struct = getattr(Config(), table)
    numbers = [name for name in struct.__struct_fields__ if is_number(getattr(struct, name))]
    assert len(numbers) > 20
    for name in numbers:
        for value in ("-1", "1e300", "99999999999999999999"):
            message = error_of(tmp_path, f"[{table}]\n{name} = {value}\n")
            assert message.startswith(f", line 2: {table}.{name}: expected"), message


@pytest.mark.parametrize(
    "key",
    ["registration.drift_rotation_rad", "registration.first_agreeing", "relocalise.turn_bins"],
)
def test_what_is_divided_by_may_not_be_zero(tmp_path: Path, key: str) -> None:
    table, name = key.split(".")
    assert f"{key}: expected" in error_of(tmp_path, f"[{table}]\n{name} = 0\n")


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def test_a_value_that_is_no_choice_names_the_choices(tmp_path: Path) -> None:
    message = error_of(tmp_path, '[odometry]\npreset = "fast"\n')
    assert message.startswith(", line 2: odometry.preset: 'fast' is none of lean, fine;")
    message = error_of(tmp_path, '[camera.v4l2]\nformats = ["GREY", "RGB3"]\n')
    assert "camera.v4l2.formats[1]: 'RGB3' is none of GREY, YUYV, NV12, MJPG;" in message


def test_a_value_of_another_form_names_the_form(tmp_path: Path) -> None:
    message = error_of(tmp_path, '[outputs.zmq]\nendpoint = "banana"\n')
    assert "outputs.zmq.endpoint: must be tcp://ADDRESS:PORT or ipc://PATH;" in message


def test_float_is_no_int(tmp_path: Path) -> None:
    assert "expected `int`" in error_of(tmp_path, "[runtime]\nrelocalise_delay_frames = 7.5\n")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_non_finite_number_is_refused(tmp_path: Path, value: str) -> None:
    message = error_of(tmp_path, f"[outputs.zmq]\nstatus_interval_s = {value}\n")
    assert message == ", line 2: outputs.zmq.status_interval_s: must be a finite number"


def test_endless_brackets_are_no_toml(tmp_path: Path) -> None:
    assert error_of(tmp_path, "a = " + "[" * 5000).startswith(": is no TOML: ")


def test_broken_toml_says_where(tmp_path: Path) -> None:
    assert "line 2" in error_of(tmp_path, "[runtime]\nx = = 1\n")


def test_binary_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_config(tmp_path / "site.toml")


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_config(path)


def test_an_empty_endpoint_means_no_commands(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('[outputs.zmq]\ncontrol = ""\n')
    assert load_config(tmp_path / "c.toml").outputs.zmq.control == ""
