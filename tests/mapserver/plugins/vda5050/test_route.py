"""What a fleet manager needs to order a map."""

import hashlib
from pathlib import Path

from support.fleet.served_api import served_api


def test_a_version_is_offered_as_the_action_that_downloads_it(tmp_path: Path) -> None:
    with served_api(tmp_path) as server:
        offered = server.client.get("/v1/sites/lab/versions/1/vda5050").json()
        assert (offered["mapId"], offered["mapVersion"]) == ("lab", "1")
        file = server.client.get(offered["mapDownloadLink"]).content
        assert hashlib.sha256(file).hexdigest() == offered["mapHash"]
