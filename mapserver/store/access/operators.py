"""Operators, their sessions and tokens. Secrets are stored as hashes only; every change is logged."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fleetmap.errors import StateError, UsageError
from mapserver.store.rows import Actor, LogEntry
from mapserver.store.transactions import Connection, Transactions

_TOKENS_KEPT_NS = 400 * 86_400_000_000_000


@dataclass(frozen=True, slots=True)
class OperatorRow:
    """One operator. role: viewer, operator, admin, or program for a name that has only tokens; password: its argon2 hash."""

    name: str
    role: str
    password: str | None
    is_disabled: int
    tokens: int = 0
    sessions: int = 0


@dataclass(frozen=True, slots=True)
class SessionRow:
    """A session, with the present role of its operator."""

    name: str
    role: str
    begun_ns: int
    used_ns: int


@dataclass(frozen=True, slots=True)
class TokenRow:
    """A token: its owner, its scopes (separated by spaces), its end and its hash."""

    name: str
    role: str
    scopes: str
    ends_ns: int
    sha256: str = ""


class OperatorQueries:
    """Operator accounts of a store. Raises StoreError on a disk error."""

    def __init__(self, transactions: Transactions) -> None:
        self._transactions = transactions

    def are_there(self) -> bool:
        """True once an operator was added; operators are disabled, never removed."""
        return bool(self._transactions.query("SELECT 1 FROM operators LIMIT 1"))

    def may_sign_in(self) -> bool:
        return bool(
            self._transactions.query("SELECT 1 FROM operators WHERE password IS NOT NULL AND is_disabled = 0 LIMIT 1")
        )

    def find(self, name: str) -> OperatorRow | None:
        return self._transactions.first(
            OperatorRow, "SELECT name, role, password, is_disabled FROM operators WHERE name = ?", (name,)
        )

    def all(self, now_ns: int, begun_after_ns: int, used_after_ns: int) -> list[OperatorRow]:
        """Return operators and programs by name, with the numbers of their tokens that are valid now, and of sessions this young."""
        return self._transactions.rows(
            OperatorRow,
            """SELECT name, role, password, is_disabled,
               (SELECT count(*) FROM tokens t WHERE t.name = o.name AND ends_ns > ?1) tokens,
               (SELECT count(*) FROM sessions s WHERE s.name = o.name AND begun_ns > ?2 AND used_ns > ?3) sessions
               FROM operators o ORDER BY name""",
            (now_ns, begun_after_ns, used_after_ns),
        )

    def tokens(self, now_ns: int) -> list[TokenRow]:
        """Return the tokens that are valid now, by name and end."""
        return self._transactions.rows(
            TokenRow,
            """SELECT name, role, scopes, ends_ns, sha256 FROM tokens JOIN operators USING (name)
               WHERE ends_ns > ? ORDER BY name, ends_ns, sha256""",
            (now_ns,),
        )

    def add(self, name: str, role: str, password: str | None, actor: Actor) -> None:
        """Add an operator; StateError if the name is taken."""
        with self._transactions.write() as connection:
            values = (name, role, password)
            done = connection.execute(
                """INSERT INTO operators (name, role, password, is_disabled) VALUES (?, ?, ?, 0)
                   ON CONFLICT DO NOTHING""",
                values,
            )
            if not done.rowcount:
                raise StateError(
                    f"operator {name} exists; `mapserver operators role {name} ROLE` or "
                    f"`mapserver operators password {name}` changes it"
                )
            self._transactions.log(connection, "", LogEntry("operator added", f"{name}, {role}", None, actor))

    def set_role(self, name: str, role: str, actor: Actor, *, keeps_an_admin: bool = False) -> None:
        """Set a role, from the next request on. UsageError for an unknown name; keeps_an_admin: StateError for the last admin."""
        with self._transactions.write() as connection, self._keeping_an_admin(name, keeps_an_admin):
            _change(connection, "UPDATE operators SET role = ? WHERE name = ?", role, name)
            self._transactions.log(connection, "", LogEntry("operator's role", f"{name}, {role}", None, actor))

    def set_password(self, name: str, password: str, actor: Actor) -> None:
        """Set a password; a disabled operator is enabled again, and sessions end. UsageError for an unknown name."""
        with self._transactions.write() as connection:
            _change(connection, "UPDATE operators SET password = ?, is_disabled = 0 WHERE name = ?", password, name)
            connection.execute("DELETE FROM sessions WHERE name = ?", (name,))
            self._transactions.log(connection, "", LogEntry("operator's password", name, None, actor))

    def disable(self, name: str, actor: Actor, *, keeps_an_admin: bool = False) -> None:
        """End sessions and tokens of a name at once, and refuse its sign-in. Errors as of `set_role`."""
        with self._transactions.write() as connection, self._keeping_an_admin(name, keeps_an_admin):
            _change(connection, "UPDATE operators SET is_disabled = 1 WHERE name = ?", name)
            for table in ("sessions", "tokens"):
                connection.execute(f"DELETE FROM {table} WHERE name = ?", (name,))
            self._transactions.log(connection, "", LogEntry("operator disabled", name, None, actor))

    @contextmanager
    def _keeping_an_admin(self, name: str, is_wanted: bool) -> Iterator[None]:
        """Raise StateError, which takes the change of the block back, if it leaves no admin who can sign in."""
        before = self.find(name)
        yield
        admins = "SELECT 1 FROM operators WHERE role = 'admin' AND password IS NOT NULL AND is_disabled = 0 LIMIT 1"
        if is_wanted and before is not None and before.role == "admin" and not self._transactions.query(admins):
            raise StateError(
                f"{name} is the last admin; add another one first, or use the command line of the server, which always can"
            )

    def begin_session(self, sha256: str, name: str, actor: Actor) -> None:
        now_ns = self._transactions.now_ns()
        with self._transactions.write() as connection:
            values = (sha256, name, now_ns, now_ns)
            connection.execute("INSERT INTO sessions (sha256, name, begun_ns, used_ns) VALUES (?, ?, ?, ?)", values)
            self._transactions.log(connection, "", LogEntry("signed in", name, None, actor))

    def session(self, sha256: str) -> SessionRow | None:
        """Return the session of this hash, unless its operator is disabled; the caller checks its age."""
        return self._transactions.first(
            SessionRow,
            """SELECT name, role, begun_ns, used_ns FROM sessions JOIN operators USING (name)
               WHERE sha256 = ? AND is_disabled = 0""",
            (sha256,),
        )

    def use_session(self, sha256: str, now_ns: int) -> None:
        with self._transactions.write(durable=False) as connection:
            connection.execute("UPDATE sessions SET used_ns = ? WHERE sha256 = ?", (now_ns, sha256))

    def end_session(self, sha256: str, actor: Actor) -> None:
        with self._transactions.write() as connection:
            connection.execute("DELETE FROM sessions WHERE sha256 = ?", (sha256,))
            self._transactions.log(connection, "", LogEntry("signed out", actor.name, None, actor))

    def remove_ended(self, *, begun_before_ns: int, used_before_ns: int) -> None:
        """Remove sessions that are too old, and tokens that ended long ago, but not those ended only by a clock far ahead."""
        with self._transactions.write(durable=False) as connection:
            connection.execute(
                "DELETE FROM sessions WHERE begun_ns < ? OR used_ns < ?", (begun_before_ns, used_before_ns)
            )
            long_ago_ns = self._transactions.now_ns() - _TOKENS_KEPT_NS
            connection.execute("DELETE FROM tokens WHERE ends_ns < ?", (long_ago_ns,))

    def add_token(self, sha256: str, token: TokenRow, actor: Actor) -> None:
        """Add a token; an unknown name becomes that of a program."""
        with self._transactions.write() as connection:
            connection.execute(
                """INSERT INTO operators (name, role, is_disabled) VALUES (?, 'program', 0)
                   ON CONFLICT DO NOTHING""",
                (token.name,),
            )
            values = (sha256, token.name, token.scopes, token.ends_ns)
            connection.execute("INSERT INTO tokens (sha256, name, scopes, ends_ns) VALUES (?, ?, ?, ?)", values)
            self._transactions.log(connection, "", LogEntry("token made", f"{token.name}: {token.scopes}", None, actor))

    def revoke_token(self, number: str, actor: Actor) -> None:
        """End a token, named by the beginning of its hash, at once. UsageError for an unknown one."""
        with self._transactions.write() as connection:
            named = "FROM tokens WHERE substr(sha256, 1, length(?1)) = ?1"
            found = connection.execute(f"SELECT name, scopes {named}", (number,)).fetchone()
            if found is None:
                raise UsageError(f"no token has the number {number}; it may have been revoked already")
            connection.execute(f"DELETE {named}", (number,))
            self._transactions.log(connection, "", LogEntry("token revoked", f"{found[0]}: {found[1]}", None, actor))

    def token(self, sha256: str) -> TokenRow | None:
        """Return the token of this hash, unless its operator is disabled; the caller checks its end."""
        return self._transactions.first(
            TokenRow,
            """SELECT name, role, scopes, ends_ns FROM tokens JOIN operators USING (name)
               WHERE sha256 = ? AND is_disabled = 0""",
            (sha256,),
        )


def _change(connection: Connection, sql: str, *values: str) -> None:
    if not connection.execute(sql, values).rowcount:
        raise UsageError(f"unknown operator {values[-1]}; `mapserver operators list` names all operators")
