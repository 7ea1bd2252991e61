"""The tables of the database. A change is a further named migration; a released one is never changed."""

import re

from sqlite_utils import Database, Migrations

MIGRATIONS = Migrations("fleetmap")

_TABLES = """
CREATE TABLE sites (
    site TEXT PRIMARY KEY,
    last_version INTEGER NOT NULL DEFAULT 0)

-- job: the one that saved the version
CREATE TABLE versions (
    site TEXT NOT NULL REFERENCES sites(site),
    version INTEGER NOT NULL CHECK (version >= 1),
    state TEXT NOT NULL CHECK (state IN ('draft', 'published', 'current', 'retired')),
    parent INTEGER,
    created TEXT NOT NULL,
    published_ns INTEGER,
    manifest_sha256 TEXT NOT NULL,
    manifest_bytes INTEGER NOT NULL,
    tiles INTEGER NOT NULL,
    tile_bytes INTEGER NOT NULL,
    landmarks INTEGER NOT NULL,
    vocabulary_sha256 TEXT NOT NULL,
    vocabulary_bytes INTEGER NOT NULL,
    archive_sha256 TEXT,
    saved_ns INTEGER NOT NULL,
    retired_ns INTEGER,
    job INTEGER,
    PRIMARY KEY (site, version))

CREATE UNIQUE INDEX one_current_per_site ON versions(site) WHERE state = 'current'

CREATE TABLE version_blobs (
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    kind TEXT NOT NULL CHECK (kind IN ('manifest', 'tile', 'vocabulary', 'archive')),
    sha256 TEXT NOT NULL,
    PRIMARY KEY (site, version, kind, sha256),
    FOREIGN KEY (site, version) REFERENCES versions(site, version)) WITHOUT ROWID

CREATE INDEX version_blobs_by_address ON version_blobs(sha256)

-- What no robot fetches: the grid of planners, and the surfels with the pictures of surveys, each an index and tiles or pictures
CREATE TABLE grid_blobs (
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (site, version, sha256),
    FOREIGN KEY (site, version) REFERENCES versions(site, version)) WITHOUT ROWID

CREATE TABLE surfel_blobs (
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (site, version, sha256),
    FOREIGN KEY (site, version) REFERENCES versions(site, version)) WITHOUT ROWID

-- What belongs to a site and to no version, such as the drawing of its building
CREATE TABLE site_files (
    site TEXT NOT NULL REFERENCES sites(site),
    kind TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (site, kind)) WITHOUT ROWID

-- What was current, in that order: rolling back takes the last row away
CREATE TABLE currents (
    id INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    since_ns INTEGER NOT NULL,
    FOREIGN KEY (site, version) REFERENCES versions(site, version))

-- What was measured of a draft when it was built; the gate judges by it later
CREATE TABLE evidence (
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    figures TEXT NOT NULL,
    PRIMARY KEY (site, version),
    FOREIGN KEY (site, version) REFERENCES versions(site, version)) WITHOUT ROWID

CREATE TABLE verdicts (
    id INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    stamp_ns INTEGER NOT NULL,
    accepted INTEGER NOT NULL CHECK (accepted IN (0, 1)),
    forced INTEGER NOT NULL CHECK (forced IN (0, 1)),
    reasons TEXT NOT NULL,
    report TEXT NOT NULL,
    FOREIGN KEY (site, version) REFERENCES versions(site, version))

CREATE INDEX verdicts_by_version ON verdicts(site, version)

CREATE TABLE canaries (
    id INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    version INTEGER NOT NULL,
    base_version INTEGER NOT NULL,
    share REAL NOT NULL,
    threshold REAL NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('running', 'promoted', 'rolled_back', 'stopped')),
    started_ns INTEGER NOT NULL,
    ended_ns INTEGER,
    actor TEXT NOT NULL,
    reason TEXT NOT NULL,
    outcome TEXT NOT NULL)

CREATE UNIQUE INDEX one_canary_per_site ON canaries(site) WHERE state = 'running'

CREATE TABLE jobs (
    id INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    kind TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('running', 'done', 'failed')),
    started TEXT NOT NULL,
    finished TEXT,
    message TEXT NOT NULL,
    report TEXT NOT NULL)

CREATE INDEX jobs_by_site ON jobs(site)

-- The log. operator: the name that was proved; sha256: chains the lines
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    stamp_ns INTEGER NOT NULL,
    site TEXT NOT NULL,
    kind TEXT NOT NULL,
    detail TEXT NOT NULL,
    version INTEGER,
    actor TEXT NOT NULL DEFAULT '',
    reason TEXT NOT NULL DEFAULT '',
    operator TEXT NOT NULL DEFAULT '',
    address TEXT NOT NULL DEFAULT '',
    sha256 TEXT NOT NULL DEFAULT '')

CREATE INDEX events_by_site ON events(site)

CREATE TRIGGER events_are_kept BEFORE DELETE ON events
    BEGIN SELECT RAISE(ABORT, 'the log of events is never shortened'); END

CREATE TRIGGER events_stay_as_they_are BEFORE UPDATE ON events
    BEGIN SELECT RAISE(ABORT, 'the log of events is never changed'); END

CREATE TABLE operators (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL CHECK (role IN ('viewer', 'operator', 'admin', 'program')),
    password TEXT,
    is_disabled INTEGER NOT NULL CHECK (is_disabled IN (0, 1))) WITHOUT ROWID

CREATE TABLE sessions (
    sha256 TEXT PRIMARY KEY,
    name TEXT NOT NULL REFERENCES operators(name),
    begun_ns INTEGER NOT NULL,
    used_ns INTEGER NOT NULL) WITHOUT ROWID

CREATE TABLE tokens (
    sha256 TEXT PRIMARY KEY,
    name TEXT NOT NULL REFERENCES operators(name),
    scopes TEXT NOT NULL,
    ends_ns INTEGER NOT NULL) WITHOUT ROWID

CREATE TABLE robots (
    site TEXT NOT NULL,
    robot TEXT NOT NULL,
    version INTEGER,
    last_seen_ns INTEGER NOT NULL,
    last_report TEXT NOT NULL,
    PRIMARY KEY (site, robot)) WITHOUT ROWID

-- What is counted by: axis is site, robot, version, tile, cause or arm (of a canary), never two of them
CREATE TABLE tally_keys (
    id INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    axis TEXT NOT NULL,
    key TEXT NOT NULL,
    UNIQUE (site, axis, key))

CREATE TABLE tallies (
    key_id INTEGER NOT NULL,
    hour INTEGER NOT NULL,
    reports INTEGER NOT NULL,
    observed_ms INTEGER NOT NULL,
    driving_ms INTEGER NOT NULL,
    after_fix_ms INTEGER NOT NULL,
    localised_ms INTEGER NOT NULL,
    usable_ms INTEGER NOT NULL,
    first_fixes INTEGER NOT NULL,
    first_fix_ms INTEGER NOT NULL,
    innovations INTEGER NOT NULL,
    innovation_sum REAL NOT NULL,
    innovation_m_sum REAL NOT NULL,
    exceeded INTEGER NOT NULL,
    jumps INTEGER NOT NULL,
    docks INTEGER NOT NULL,
    docks_wrong INTEGER NOT NULL,
    cpu_reports INTEGER NOT NULL,
    cpu_ms_sum REAL NOT NULL,
    frames INTEGER NOT NULL,
    frames_dropped INTEGER NOT NULL,
    landmarks_expected INTEGER NOT NULL,
    landmarks_seen INTEGER NOT NULL,
    failures INTEGER NOT NULL,
    suspected INTEGER NOT NULL,
    blind_failures INTEGER NOT NULL,
    blind_seen INTEGER NOT NULL,
    judged_ms INTEGER NOT NULL,
    found_ms INTEGER NOT NULL,
    continued INTEGER NOT NULL,
    PRIMARY KEY (key_id, hour)) WITHOUT ROWID

-- heard_ns: by the server's clock
CREATE TABLE traces (
    hour INTEGER NOT NULL,
    key_id INTEGER NOT NULL,
    stamp_ns INTEGER NOT NULL,
    status TEXT NOT NULL,
    version INTEGER,
    x_map_m REAL,
    y_map_m REAL,
    radius_95_m REAL,
    heard_ns INTEGER NOT NULL,
    flags TEXT,
    frame_ms REAL,
    exposure REAL,
    sharpness REAL,
    PRIMARY KEY (hour, key_id, stamp_ns)) WITHOUT ROWID

-- area: the named area in which it happened, as the site's areas are now
CREATE TABLE failures (
    number INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    robot TEXT NOT NULL,
    failure_id TEXT NOT NULL,
    received_ns INTEGER NOT NULL,
    happened_ns INTEGER NOT NULL,
    duration_s REAL NOT NULL,
    kind TEXT NOT NULL,
    cause TEXT NOT NULL,
    status TEXT NOT NULL,
    version INTEGER,
    tile TEXT,
    x_map_m REAL,
    y_map_m REAL,
    report BLOB NOT NULL,
    area TEXT,
    UNIQUE (site, robot, failure_id))

CREATE INDEX failures_by_time ON failures(site, happened_ns)

CREATE TABLE failure_pictures (
    number INTEGER NOT NULL REFERENCES failures(number) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    kind TEXT NOT NULL,
    stamp_ns INTEGER NOT NULL,
    jpeg BLOB NOT NULL,
    PRIMARY KEY (number, place))

-- The recording of the seconds around a failure, and its summary
CREATE TABLE failure_replays (
    number INTEGER PRIMARY KEY REFERENCES failures(number) ON DELETE CASCADE,
    summary BLOB NOT NULL,
    mcap BLOB NOT NULL)
"""

STATEMENTS = _TABLES.strip().split("\n\n")
TABLES = re.findall(r"CREATE TABLE (\w+)", _TABLES)
"""Their names, each after those that it refers to."""


@MIGRATIONS()
def tables(database: Database) -> None:
    """Create the first schema."""
    for statement in STATEMENTS:
        database.execute(statement)


FORMAT = 12 + len(MIGRATIONS.pending(Database(memory=True)))  # there were 12 before migrations had names
"""SQLite's user_version of a database with all migrations: reveals an older database by its header, and is newer for older programs."""
