"""Tools for kernels: compilation, SIMD, threads, element-wise functions, rotations."""
