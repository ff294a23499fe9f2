"""The instrument: lidar, pulse, receiver."""
