"""Changes of a site's releases, in the transaction that reads their state. `mapserver.releases` decides them."""

from mapserver.store.database import Database, Transaction
from mapserver.store.queries import site_releases
from mapserver.store.rows import Actor


class Release:
    """Changes of one site. rows: the state before them."""

    def __init__(self, database: Database, change: Transaction, site: str) -> None:
        self._change, self._site, self._now_ns = change, site, database.now_ns()
        self.rows = site_releases(database, site)
        self.has_new_current = False

    def set_state(self, version: int, state: str) -> None:
        """Set a version published, current or retired, with the time of the first and of the last."""
        self.has_new_current |= state == "current"
        self._change.execute(
            """UPDATE versions SET state = ?, published_ns = coalesce(published_ns, ?), retired_ns = ?
               WHERE site = ? AND version = ?""",
            (state, self._now_ns, self._now_ns if state == "retired" else None, self._site, version),
        )

    def make_current(self, version: int) -> None:
        """Make a version current instead of the present one, which stays published."""
        if self.rows.current is not None:
            self.set_state(self.rows.current.version, "published")
        self.set_state(version, "current")
        self._change.insert("currents", [{"site": self._site, "version": version, "since_ns": self._now_ns}])

    def roll_back(self, version: int) -> None:
        """Make the rollback target current again; the present version retires, and leaves the history of current ones."""
        if self.rows.current is not None:
            self.set_state(self.rows.current.version, "retired")
        self.set_state(version, "current")
        self._change.execute(
            """DELETE FROM currents WHERE site = ? AND id > (SELECT max(id) FROM currents WHERE site = ? AND version = ?)""",
            (self._site, self._site, version),
        )

    def begin_canary(self, version: int, base_version: int, share: float, threshold: float, actor: Actor) -> None:
        """Begin a canary; its version, perhaps a draft, is published."""
        self.set_state(version, "published")
        row = {"site": self._site, "version": version, "base_version": base_version, "share": share}
        row |= {"threshold": threshold, "state": "running", "started_ns": self._now_ns, "outcome": ""}
        self._change.insert("canaries", [row | {"actor": actor.name, "reason": actor.reason}])

    def end_canary(self, state: str, outcome: str) -> None:
        """End the running canary: promoted, rolled_back or stopped, and the reason."""
        query = "UPDATE canaries SET state = ?, ended_ns = ?, outcome = ? WHERE site = ? AND state = 'running'"
        self._change.execute(query, (state, self._now_ns, outcome, self._site))

    def log(self, kind: str, detail: str, version: int, actor: Actor) -> None:
        self._change.log(self._site, kind, detail, version, actor)
