# SPDX-License-Identifier: Apache-2.0
"""Pure image kernels: pyramids, gradients, sampling."""
