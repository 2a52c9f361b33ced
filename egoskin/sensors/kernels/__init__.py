"""The sensors' kernels: C++ with its compilation, Warp, and the Python binding."""
