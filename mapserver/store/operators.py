"""Operators, their sessions and tokens. Secrets are stored as hashes only; every change is logged."""

from collections.abc import Iterator
from contextlib import contextmanager

from fleetmap.errors import StateError, UsageError
from mapserver.store.database import Database, Transaction
from mapserver.store.rows import Actor, OperatorRow, SessionRow, TokenRow

_TOKENS_KEPT_NS = 400 * 86_400_000_000_000
_IF_ENABLED = "JOIN operators USING (name) WHERE sha256 = ? AND is_disabled = 0"


class OperatorQueries:
    """Operator accounts of a store. Raises StoreError on a disk error, UsageError for an unknown name."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def are_there(self) -> bool:
        """True once an operator was added; operators are disabled, never removed."""
        return self._database.value("SELECT 1 FROM operators LIMIT 1") is not None

    def may_sign_in(self) -> bool:
        query = "SELECT 1 FROM operators WHERE password IS NOT NULL AND is_disabled = 0 LIMIT 1"
        return self._database.value(query) is not None

    def find(self, name: str) -> OperatorRow | None:
        query = "SELECT name, role, password, is_disabled FROM operators WHERE name = ?"
        return next(iter(self._database.rows(OperatorRow, query, (name,))), None)

    def all(self, now_ns: int, begun_after_ns: int, used_after_ns: int) -> list[OperatorRow]:
        """Return operators and programs by name, with the numbers of their tokens that are valid now, and of sessions this young."""
        return self._database.rows(
            OperatorRow,
            """SELECT name, role, password, is_disabled,
               (SELECT count(*) FROM tokens t WHERE t.name = o.name AND ends_ns > ?) tokens,
               (SELECT count(*) FROM sessions s WHERE s.name = o.name AND begun_ns > ? AND used_ns > ?) sessions
               FROM operators o ORDER BY name""",
            (now_ns, begun_after_ns, used_after_ns),
        )

    def add(self, name: str, role: str, password: str | None, actor: Actor) -> None:
        """Add an operator; StateError if the name is taken."""
        with self._changing("operator added", f"{name}, {role}", actor) as change:
            row = {"name": name, "role": role, "password": password, "is_disabled": 0}
            if not change.insert("operators", [row], "ON CONFLICT DO NOTHING").rowcount:
                raise StateError(
                    f"operator {name} exists; `mapserver operators role {name} ROLE` or "
                    f"`mapserver operators password {name}` changes it"
                )

    def set_role(self, name: str, role: str, actor: Actor, *, keeps_an_admin: bool = False) -> None:
        """Set a role, from the next request on. keeps_an_admin: StateError for the last admin."""
        with self._changing("operator's role", f"{name}, {role}", actor) as change:
            if keeps_an_admin and role != "admin":
                self._check_another_admin(name)
            _set(change, name, "role = ?", role)

    def set_password(self, name: str, password: str, actor: Actor) -> None:
        """Set a password; a disabled operator is enabled again, and sessions end."""
        with self._changing("operator's password", name, actor) as change:
            _set(change, name, "password = ?, is_disabled = 0", password)
            change.execute("DELETE FROM sessions WHERE name = ?", (name,))

    def disable(self, name: str, actor: Actor, *, keeps_an_admin: bool = False) -> None:
        """End sessions and tokens of a name at once, and refuse its sign-in. keeps_an_admin: as of `set_role`."""
        with self._changing("operator disabled", name, actor) as change:
            if keeps_an_admin:
                self._check_another_admin(name)
            _set(change, name, "is_disabled = ?", 1)
            for table in ("sessions", "tokens"):
                change.execute(f"DELETE FROM {table} WHERE name = ?", (name,))

    def session(self, sha256: str) -> SessionRow | None:
        """Return the session of this hash, unless its operator is disabled; the caller checks its age."""
        query = f"SELECT name, role, begun_ns, used_ns FROM sessions {_IF_ENABLED}"
        return next(iter(self._database.rows(SessionRow, query, (sha256,))), None)

    def begin_session(self, sha256: str, actor: Actor, *, life_ns: int, idle_ns: int) -> None:
        """Begin a session of the actor. Those that are too old are removed, and tokens that ended long ago, but not those ended only by a
        clock far ahead."""
        now_ns = self._database.now_ns()
        with self._changing("signed in", actor.name, actor) as change:
            row = {"sha256": sha256, "name": actor.name, "begun_ns": now_ns, "used_ns": now_ns}
            change.insert("sessions", [row])
            old = "DELETE FROM sessions WHERE begun_ns < ? OR used_ns < ?"
            change.execute(old, (now_ns - life_ns, now_ns - idle_ns))
            change.execute("DELETE FROM tokens WHERE ends_ns < ?", (now_ns - _TOKENS_KEPT_NS,))

    def use_session(self, sha256: str, now_ns: int) -> None:
        with self._database.write(durable=False) as change:
            change.execute("UPDATE sessions SET used_ns = ? WHERE sha256 = ?", (now_ns, sha256))

    def end_session(self, sha256: str, actor: Actor) -> None:
        with self._changing("signed out", actor.name, actor) as change:
            change.execute("DELETE FROM sessions WHERE sha256 = ?", (sha256,))

    def token(self, sha256: str) -> TokenRow | None:
        """Return the token of this hash, unless its operator is disabled; the caller checks its end."""
        query = f"SELECT name, role, scopes, ends_ns FROM tokens {_IF_ENABLED}"
        return next(iter(self._database.rows(TokenRow, query, (sha256,))), None)

    def tokens(self, now_ns: int) -> list[TokenRow]:
        """Return the tokens that are valid now, by name and end."""
        tables = "tokens JOIN operators USING (name)"
        return self._database.select(TokenRow, tables, {"ends_ns >": now_ns}, "name, ends_ns, sha256")

    def add_token(self, sha256: str, token: TokenRow, actor: Actor) -> None:
        """Add a token; an unknown name becomes that of a program."""
        with self._changing("token made", f"{token.name}: {token.scopes}", actor) as change:
            program = {"name": token.name, "role": "program", "is_disabled": 0}
            change.insert("operators", [program], "ON CONFLICT DO NOTHING")
            row = {"sha256": sha256, "name": token.name, "scopes": token.scopes, "ends_ns": token.ends_ns}
            change.insert("tokens", [row])

    def revoke_token(self, number: str, actor: Actor) -> None:
        """End a token, named by the beginning of its hash, at once. UsageError for an unknown one."""
        with self._database.write() as change:
            query = "DELETE FROM tokens WHERE substr(sha256, 1, length(?)) = ? RETURNING name, scopes"
            found = change.execute(query, (number, number)).fetchall()
            if not found:
                raise UsageError(f"no token has the number {number}; it may have been revoked already")
            change.log("", "token revoked", f"{found[0][0]}: {found[0][1]}", actor=actor)

    @contextmanager
    def _changing(self, kind: str, detail: str, actor: Actor) -> Iterator[Transaction]:
        """Run a write transaction that is logged at its end."""
        with self._database.write() as change:
            yield change
            change.log("", kind, detail, actor=actor)

    def _check_another_admin(self, name: str) -> None:
        """Raise StateError for an admin without whom no admin could sign in."""
        others = (
            "SELECT 1 FROM operators WHERE role = 'admin' AND password IS NOT NULL AND is_disabled = 0 AND name <> ?"
        )
        known = self.find(name)
        if known is not None and known.role == "admin" and self._database.value(others, (name,)) is None:
            raise StateError(
                f"{name} is the last admin; add another one first, or use the command line of the server, which always can"
            )


def _set(change: Transaction, name: str, what: str, value: object) -> None:
    if not change.execute(f"UPDATE operators SET {what} WHERE name = ?", (value, name)).rowcount:
        raise UsageError(f"unknown operator {name}; `mapserver operators list` names all operators")
