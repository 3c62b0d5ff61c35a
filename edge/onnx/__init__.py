# SPDX-License-Identifier: Apache-2.0
"""Models as ONNX files: what is in them, and how they are opened on a small computer."""
