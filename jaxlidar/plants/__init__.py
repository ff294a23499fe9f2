"""Plants as geometry: L-systems, trees, forests, and their voxel maps."""
