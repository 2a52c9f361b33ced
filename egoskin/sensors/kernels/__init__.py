"""The sensors' C++ kernels: their source, how it is compiled and called."""
