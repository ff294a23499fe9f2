"""Plans: which effects are simulated and why, bounds on what each changes, and the sizes of all loops."""
