"""Scenes: canopies in voxels, surfaces, atmosphere."""
