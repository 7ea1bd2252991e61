"""The beginning of a survey in segments: made in parallel, judged at their joints; what cannot be joined is made in one piece."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

from fleetmap.errors import SurveyError
from mapserver.survey.chain import AdjustedChain, begun_chain
from mapserver.survey.keyframes.keyframes import ImageStore, MemoryImageStore, set_aside
from mapserver.survey.odometry_pass import Cut
from mapserver.survey.segments.join import joined_chain, refusal
from mapserver.survey.segments.segment import (
    Rig,
    Segment,
    SegmentSurvey,
    planned,
    segment_survey,
    survey_alone,
    survey_segment,
    task_of,
)
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

_Made = tuple[Segment, SegmentSurvey | str]  # in words why there is none


def begun_in_segments(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    """As `begun_chain`; a survey that is long enough, and whose odometry has metres of its own, is cut. Where goes by its frames alone.

    A segment whose odometry starts on the way, in the overlap, may fail to find its feet there. Then the one before goes on in its
    place, as it would have without the cut, and `cuts` of the odometry say so.
    """
    if inputs.parts is None or inputs.initial_trajectory is not None or inputs.rectifier.camera.baseline_m == 0:
        return begun_chain(inputs, settings, tools)
    segments = planned(inputs.parts.stamps_ns, settings.segments)
    rig = Rig(inputs.calibration, inputs.rectifier, settings)
    if tools.images is None:
        tools = replace(tools, images=MemoryImageStore())
    made = list(_in_parallel(segments, rig, inputs, tools)) if len(segments) > 1 else []
    refused: dict[int, str] = {}
    while wrong := _refusals(made):
        refused |= wrong
        made = list(_made_again(made, refused, rig, inputs, tools))
    cuts = _cuts(segments, refused, inputs)
    if not made:
        chain = begun_chain(inputs, settings, tools)
        return replace(chain, odometry=replace(chain.odometry, cuts=cuts))
    return joined_chain([survey for _, survey in made if isinstance(survey, SegmentSurvey)], cuts, inputs)


def _in_parallel(segments: Sequence[Segment], rig: Rig, inputs: SurveyInputs, tools: SurveyTools) -> Iterator[_Made]:
    """What became of each; what processes return of pictures goes into the survey's own store as it comes."""
    images = tools.images
    assert images is not None
    tasks = (task_of(segment, inputs, images) for segment in segments)
    for segment, survey in zip(segments, tools.executor.map(survey_segment, rig, tasks), strict=True):
        tools.at("odometry", segment.last + 1, inputs.frame_count)
        tools.release()
        yield segment, survey if isinstance(survey, str) else _stored(survey, images)


def _stored(survey: SegmentSurvey, images: ImageStore) -> SegmentSurvey:
    keyframes = [
        k if k.images is images else set_aside(replace(k, images=images, image_number=images.put(k.pictures)), images)
        for k in survey.odometry.keyframes
    ]
    return replace(survey, odometry=replace(survey.odometry, keyframes=keyframes))


def _refusals(made: Sequence[_Made]) -> dict[int, str]:
    """Why neighbours cannot be joined, by the frame between them."""
    found = {}
    for (_, before), (segment, after) in pairwise(made):
        if isinstance(before, str) or isinstance(after, str):
            reason: str | None = before if isinstance(before, str) else str(after)
        else:
            reason = refusal(before, after)
        if reason is not None:
            found[segment.begin] = reason
    return found


def _made_again(
    made: Sequence[_Made], refused: dict[int, str], rig: Rig, inputs: SurveyInputs, tools: SurveyTools
) -> Iterator[_Made]:
    """Neighbours that could not be joined as one segment each; nothing if that is the whole survey, which needs no segments."""
    groups: list[list[_Made]] = []
    for each in made:
        if groups and each[0].begin in refused:
            groups[-1].append(each)
        else:
            groups.append([each])
    if len(groups) == 1:
        return
    for group in groups:
        if len(group) == 1:
            yield group[0]
            continue
        whole = Segment(group[0][0].lead, group[0][0].begin, group[-1][0].last)
        try:
            # Here, not in a process elsewhere: it may be long, and the survey's own store keeps its pictures out of memory.
            assert tools.images is not None
            yield whole, segment_survey(survey_alone(rig, task_of(whole, inputs, tools.images), tools), whole)
        except SurveyError as error:
            yield whole, str(error)


def _cuts(segments: Sequence[Segment], refused: dict[int, str], inputs: SurveyInputs) -> tuple[Cut, ...]:
    assert inputs.parts is not None
    stamps_ns = inputs.parts.stamps_ns
    return tuple(
        Cut(s.begin, float(stamps_ns[s.begin] - stamps_ns[0]) * 1e-9, refused.get(s.begin)) for s in segments[1:]
    )
