"""What a test of the road says of the plug-in that it needs: `@needs_plugin("kitti")`."""

import pytest

from fleetmap.hooks import plugins


def needs_plugin(name: str, group: str = "fleetmap.recordings") -> pytest.MarkDecorator:
    """Skip a test, or one of its cases, where nothing of that name is registered in the group."""
    return pytest.mark.skipif(name not in plugins(group), reason=f"the plug-in {name} of {group} is not installed")
