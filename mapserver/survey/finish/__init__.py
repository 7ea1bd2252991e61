"""From the adjusted state to the finished map: culling, trajectory, docks, assembly."""
