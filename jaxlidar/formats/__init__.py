"""Files of others: recorded waveforms, points, tree models, meshes, terrain and tables, read and written."""
