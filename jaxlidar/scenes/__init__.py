"""Scenes: voxel maps, surfaces, atmosphere."""
