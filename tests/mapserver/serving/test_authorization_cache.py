"""What may be fetched is remembered for some seconds, what may not is asked for each time."""

from mapserver.serving.caches import AuthorizationCache


def test_the_store_is_asked_once_in_some_seconds() -> None:
    published, asked, now = {("tile", "hall"): "tile"}, [], {"s": 100.0}

    def ask(sha256: str, site: str) -> str | None:
        asked.append(sha256)
        return published.get((sha256, site))

    kinds = AuthorizationCache(ask, lambda: now["s"])
    assert [kinds.get("tile", "hall") for _ in range(3)] == ["tile"] * 3
    assert asked == ["tile"]
    assert kinds.get("tile", "lab") is None
    assert kinds.get("draft", "hall") is None
    published["draft", "hall"] = "tile"
    assert kinds.get("draft", "hall") == "tile"
    published.clear()
    assert kinds.get("tile", "hall") == "tile"
    now["s"] += 6.0
    assert kinds.get("tile", "hall") is None
