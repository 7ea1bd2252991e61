"""Sign-in of operators, and authentication of requests.

Passwords are hashed by argon2 with the low-memory profile of RFC 9106, section 4, one at a time: each takes 64 MiB. Sessions and tokens are
256 random bits; the store keeps their SHA-256.
"""

import hashlib
import secrets
import threading
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from fleetmap.errors import StateError, UsageError
from mapserver.fleet.rate_limit import RateLimit
from mapserver.operators.roles import SCOPES, Identity, check_operator_name
from mapserver.store import Actor, MapStore, OperatorRow, TokenRow
from mapserver.trust.keys import make_passphrase

if TYPE_CHECKING:
    from collections.abc import Iterable

    from argon2 import PasswordHasher

IDLE_S, LIFE_S = 3600, 12 * 3600
TRIES, TRY_EVERY_S = 5, 12
ADDRESS_TRIES, ADDRESS_TRY_EVERY_S = 20, 2  # for all names: one address can use at most half of the server's time
MIN_PASSWORD, MAX_PASSWORD = 12, 1000
MAX_TOKEN_DAYS = 400
_WAITING = 4  # sign-ins in the queue: more would occupy the threads for other requests
_NOTE_USE_EVERY_S = 60
_NOTES, _NOTE_EVERY_S = 60, 60  # refusals in the log, which is never pruned
_LOOK_EVERY_S = 1


class SignIn(NamedTuple):
    """Result of a sign-in: the session's secret, or a refusal and the seconds until the next attempt."""

    session: str = ""
    refusal: str = ""
    retry_s: int = 0


class Operators:
    """The operators of an open store. Thread-safe."""

    def __init__(self, store: MapStore) -> None:
        self._store, self._now_ns = store, store.now_ns
        self._verifying, self._waiting = threading.Lock(), threading.BoundedSemaphore(_WAITING)
        self._tries = RateLimit(TRIES, 1 / TRY_EVERY_S, self._now_ns)
        self._addresses = RateLimit(ADDRESS_TRIES, 1 / ADDRESS_TRY_EVERY_S, self._now_ns)
        self._notes = RateLimit(_NOTES, 1 / _NOTE_EVERY_S, self._now_ns)
        self._unnoted = 0
        self._are_there, self._looked_ns = False, -(10**18)

    @property
    def is_sign_in_on(self) -> bool:
        """True once an operator was added; from then on every request needs a session or a token."""
        is_due = abs(self._now_ns() - self._looked_ns) > _LOOK_EVERY_S * 1e9  # also of a clock set back
        if not self._are_there and is_due:
            self._looked_ns, self._are_there = self._now_ns(), self._store.operators.are_there()
        return self._are_there

    def all(self) -> list[OperatorRow]:
        """Return operators and programs by name, with the numbers of their valid sessions and tokens."""
        now_ns = self._now_ns()
        return self._store.operators.all(now_ns, now_ns - LIFE_S * 10**9, now_ns - IDLE_S * 10**9)

    def add(self, name: str, role: str, password: str | None, actor: Actor) -> str:
        """Add an operator and return the password, a generated one for None. UsageError for a taken or invalid name, or such a password."""
        password, hashed = self._hashed(check_operator_name(name), password)
        self._store.operators.add(name, role, hashed, actor)
        self._are_there = True
        return password

    def set_password(self, name: str, password: str | None, actor: Actor) -> str:
        """Set and return a password, as `add`; ends all sessions. UsageError for an unknown name and a program."""
        password, hashed = self._hashed(name, password)
        self._store.operators.set_password(name, hashed, actor)
        return password

    def set_role(self, name: str, role: str, actor: Actor, *, keeps_an_admin: bool = False) -> None:
        """Set a role, from the next request on. Errors as of `set_password`; keeps_an_admin: StateError for the last admin."""
        self._check_person(name)
        self._store.operators.set_role(name, role, actor, keeps_an_admin=keeps_an_admin)

    def make_token(self, name: str, scopes: "Iterable[str]", days: float, actor: Actor) -> str:
        """Create a token, shown once; without an operator of that name it is a program's.

        UsageError for an invalid name, StateError for a disabled one.
        """
        known = self._store.operators.find(name)
        if known is not None and known.is_disabled:
            raise StateError(f"{name} is disabled, so that its tokens are refused; choose another name")
        token, ends_ns = secrets.token_urlsafe(32), self._now_ns() + int(days * 86_400e9)
        row = TokenRow(check_operator_name(name), "", " ".join(sorted(set(scopes))), ends_ns)
        self._store.operators.add_token(_digest(token), row, actor)
        return token

    def sign_in(self, name: str, password: str, address: str) -> SignIn:
        """Return a session for a name and password, or a refusal that does not reveal which of the two is wrong."""
        if not self._waiting.acquire(blocking=False):
            return SignIn(refusal="Too many sign-ins at the moment. Try again.", retry_s=2)
        try:
            return self._sign_in(name, password, address)
        finally:
            self._waiting.release()

    def _sign_in(self, name: str, password: str, address: str) -> SignIn:
        name = ascii(name[:64])[1:-1]  # valid names are unchanged, others match no operator
        who = Actor(name, address=address)
        if not (self._addresses.admits(address) and self._tries.admits((name, address))):
            self.note("sign-in refused", "too many tries", who)
            return SignIn(refusal="Too many tries. Wait before the next one.", retry_s=TRY_EVERY_S)
        row = self._store.operators.find(name)
        stored = None if row is None or row.is_disabled else row.password
        with self._verifying:
            # Unknown names take as long as known ones, against timing attacks.
            is_right = _verified(stored or _dummy(), password[:MAX_PASSWORD])
        if stored is None or not is_right:
            self.note("sign-in refused", "wrong name or password", who)
            return SignIn(refusal="Wrong name or password.")
        session = secrets.token_urlsafe(32)
        who, kept = who._replace(operator=name), {"life_ns": LIFE_S * 10**9, "idle_ns": IDLE_S * 10**9}
        self._store.operators.begin_session(_digest(session), who, **kept)
        return SignIn(session)

    def sign_out(self, who: Identity) -> None:
        if who.proof:
            self._store.operators.end_session(who.proof, who.actor())

    def identify(self, session: str, authorization: str, address: str, *, uses: bool = True) -> Identity | None:
        """Return the owner of this cookie or this `Authorization`; None if invalid. uses: True if this extends the session."""
        scheme, _, token = authorization.partition(" ")
        if scheme.lower() == "bearer":
            held = self._store.operators.token(_digest(token.strip()))
            if held is None or held.ends_ns <= self._now_ns():
                return None
            scopes = SCOPES[held.role] & set(held.scopes.split())
            return Identity(held.name, held.role, scopes, address, is_token=True)
        if not session:
            return None
        sha256, now_ns = _digest(session), self._now_ns()
        row = self._store.operators.session(sha256)
        if row is None or not _is_within(now_ns - row.begun_ns, LIFE_S) or not _is_within(now_ns - row.used_ns, IDLE_S):
            return None
        if uses and now_ns - row.used_ns > _NOTE_USE_EVERY_S * 1e9:
            self._store.operators.use_session(sha256, now_ns)
        return Identity(row.name, row.role, SCOPES[row.role], address, sha256)

    def note(self, kind: str, detail: str, actor: Actor) -> None:
        """Log an event that strangers can cause: after the first 60 one line a minute, with the number left out."""
        if not self._notes.admits("notes"):
            self._unnoted += 1
            return
        more, self._unnoted = self._unnoted, 0
        self._store.audit(kind, f"{detail} (and {more} lines left out)" if more else detail, actor=actor)

    def _hashed(self, name: str, password: str | None) -> tuple[str, str]:
        """Return a password for this name, and its hash."""
        self._check_person(name)
        password = make_passphrase() if password is None else password
        if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
            raise UsageError(
                f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters, not {len(password)}; a generated one has them"
            )
        with self._verifying:
            return password, _hasher().hash(password)

    def _check_person(self, name: str) -> None:
        row = self._store.operators.find(name)
        if row is not None and row.role == "program":
            raise StateError(f"{name} is a program, which has tokens alone; choose another name for a person")


def _is_within(age_ns: int, most_s: float) -> bool:
    """True if an age is within the limit. More than a minute in the future is refused: such a clock was ahead."""
    return -60e9 <= age_ns <= most_s * 1e9


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def _verified(stored: str, password: str) -> bool:
    from argon2.exceptions import InvalidHashError, VerificationError

    try:
        return _hasher().verify(stored, password)
    except (VerificationError, InvalidHashError, UnicodeError):
        return False


@cache
def _hasher() -> "PasswordHasher":
    from argon2 import PasswordHasher
    from argon2.profiles import RFC_9106_LOW_MEMORY

    return PasswordHasher.from_parameters(RFC_9106_LOW_MEMORY)


@cache
def _dummy() -> str:
    return _hasher().hash(secrets.token_urlsafe())
