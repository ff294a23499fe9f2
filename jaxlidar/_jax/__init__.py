"""Around JAX: compiled programs, their cache, threads and workers, loops and products of matrices."""
