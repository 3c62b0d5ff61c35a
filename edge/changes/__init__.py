# SPDX-License-Identifier: Apache-2.0
"""Which objects have come and gone: what should be seen, what is, and what that tells."""
