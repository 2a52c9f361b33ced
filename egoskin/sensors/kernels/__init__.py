"""The sensors' C++ kernels: source, compilation and Python binding."""
