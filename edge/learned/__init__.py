# SPDX-License-Identifier: Apache-2.0
"""Features from a user's ONNX model, as another layer of a map beside ORB's."""
