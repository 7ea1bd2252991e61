"""Selection of a map's vocabulary: the site's, that of a file, the shipped one, or its own where that is measurably better."""

from dataclasses import dataclass, replace
from pathlib import Path

from fleetmap.bow import Vocabulary, decode_vocabulary, vocabulary_hash
from fleetmap.bow.shipped_vocabulary import DEFAULT_VOCABULARY_SHA256, default_vocabulary
from fleetmap.errors import MapFormatError, StoreError, UsageError
from mapserver.store import MapStore
from mapserver.survey.loops.vocabulary_evaluation import VocabularyEvaluation, try_own_vocabulary
from mapserver.survey.pipeline import Survey
from mapserver.survey.settings import SurveySettings


@dataclass(frozen=True)
class ChosenVocabulary:
    """A vocabulary, where it is from (site, file, default, own) and the trial that led to it, if there was one."""

    vocabulary: Vocabulary
    source: str
    trial: VocabularyEvaluation | None = None

    def sha256(self) -> str:
        """Its hash, by which maps name it."""
        return vocabulary_hash(self.vocabulary)

    def download_bytes(self, encoded_bytes: int) -> int:
        """Bytes that a robot downloads of it: none of the shipped one."""
        return 0 if self.sha256() == DEFAULT_VOCABULARY_SHA256 else encoded_bytes


def choose_vocabulary(maps: MapStore, site: str, file: Path | None) -> ChosenVocabulary:
    """The vocabulary for a new survey of the site. UsageError where the file's is not the one that the site has published."""
    kept = maps.site_vocabulary(site)
    if file is None and kept is not None:
        return ChosenVocabulary(decode_vocabulary(kept), "site")
    given = _given_or_shipped(file)
    if file is None:
        return given
    published = next((info.vocabulary_sha256 for info in maps.sites() if info.site == site), None)
    if published not in (None, given.sha256()):
        raise UsageError(
            f"--vocabulary {file} is {given.sha256()[:12]}, site {site} has published {published[:12]} and its robots speak it; "
            "build without --vocabulary, or under another site's name"
        )
    return given


def _given_or_shipped(file: Path | None) -> ChosenVocabulary:
    if file is None:
        return ChosenVocabulary(default_vocabulary(), "default")
    return ChosenVocabulary(read_vocabulary(file), "file")


def first_vocabulary(store: Path, site: str, file: Path | None) -> ChosenVocabulary | None:
    """The same for a site that has no version yet, of a store that may not be there; None for others, whose maps have their own camera."""
    try:
        with MapStore.open(store) as maps:
            is_new = site not in {info.site for info in maps.sites()} or maps.current(site) is None
            return choose_vocabulary(maps, site, file) if is_new else None
    except StoreError:  # there is none; what else is wrong with it is said where it is made
        return _given_or_shipped(file)


def judged(chosen: ChosenVocabulary, done: Survey, settings: SurveySettings) -> ChosenVocabulary:
    """The same, or the survey's own vocabulary where its first map shows that it finds revisits better than the default."""
    if chosen.source != "default":
        return chosen
    stamps = set(done.map.keyframe_stamps_ns.tolist())
    descriptors = [k.features.descriptors for k in done.odometry.keyframes if k.stamp_ns in stamps]
    trial, own = try_own_vocabulary(
        done.map, descriptors, chosen.vocabulary, settings.vocabulary, settings.loops.min_gap_keyframes, settings.seed
    )
    return replace(chosen, trial=trial) if own is None else ChosenVocabulary(own, "own", trial)


def read_vocabulary(file: Path) -> Vocabulary:
    """The vocabulary in a file; UsageError where it cannot be read or is none."""
    try:
        return decode_vocabulary(file.read_bytes())
    except OSError as error:
        raise UsageError(
            f"{file} cannot be read ({error.strerror}); name a file of `mapserver train-vocabulary`"
        ) from error
    except MapFormatError as error:
        raise UsageError(f"{file}: {error}; name a file of `mapserver train-vocabulary`") from error
