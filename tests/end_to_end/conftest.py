"""One published site for all tests of a process that need a map."""

import pytest

from support.room_site import RoomSite


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> RoomSite:
    return RoomSite(tmp_path_factory.mktemp("site"))
