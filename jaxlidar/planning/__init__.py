"""Plans: what will be simulated, why, to what bound, and the sizes of all loops."""
