# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, load, numpy_helper, save

from edge.errors import ModelRefused
from edge.onnx.outline import look_into


def write(path: Path, op: str, dtype: type[np.floating]) -> Path:
    weights = numpy_helper.from_array(np.zeros((3, 3), dtype), "w")
    node = helper.make_node(op, ["x"], ["y", "s", "z"] if op.startswith("Dynamic") else ["y"])
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [4])
    out = helper.make_tensor_value_info("y", TensorProto.FLOAT, [4])
    graph = helper.make_graph([node], "g", [value], [out], [weights])
    opsets = [helper.make_opsetid("com.other", 3000), helper.make_opsetid("", 18)]
    save(helper.make_model(graph, opset_imports=opsets), path)
    return path


@pytest.mark.parametrize("op", ["Relu", "DynamicQuantizeLinear"])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_opset_operators_and_weights_are_found(
    op: str, dtype: type[np.floating], tmp_path: Path
) -> None:
    found = look_into(write(tmp_path / "m.onnx", op, dtype))

    assert found.opset == 18
    assert found.n_nodes == 1
    assert found.is_dynamic_int8 == (op != "Relu")
    assert found.is_half == (dtype is np.float16)


def test_weights_beside_a_model_are_missed_by_name(tmp_path: Path) -> None:
    path, weights = write(tmp_path / "m.onnx", "Relu", np.float32), tmp_path / "m.bin"
    save(load(path), path, save_as_external_data=True, location=weights.name, size_threshold=0)

    assert look_into(path).beside == {"m.bin": 36}
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(ModelRefused, match=r"weights lie in m\.bin, which is cut off"):
        look_into(path)
    weights.unlink()
    with pytest.raises(ModelRefused, match=r"weights lie in m\.bin, which is missing"):
        look_into(path)


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "m.onnx")

    for path in (tmp_path, tmp_path / "m.onnx"):
        with pytest.raises(ModelRefused, match="is no file"):
            look_into(path)


def test_a_file_cut_anywhere_is_refused_or_read_but_never_breaks(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx", "Relu", np.float32)
    data = path.read_bytes()
    for length in range(0, len(data), 3):
        path.write_bytes(data[:length])
        try:
            look_into(path)
        except ModelRefused as error:
            assert "cut off" in str(error)  # noqa: PT017  # some lengths end between two fields
