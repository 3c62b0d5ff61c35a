"""Pure image kernels: pyramids, gradients, sampling."""
