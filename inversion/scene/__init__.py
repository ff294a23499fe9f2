"""Properties of a scene, and of the lidar over it, from many records."""
