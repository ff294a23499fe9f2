"""Scenes: canopies in voxels, ground and plates, atmosphere."""
