"""The march of a ray through voxels, and to surfaces and meshes."""
