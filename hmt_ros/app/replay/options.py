"""Options of a replay, and the resulting parameters of the nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from hmt_ros.app.replay.inputs import RECORDED_INPUTS, RecordedInput, recorded_input, upright_frame
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.declared_parameters import OWN_SOURCE, with_values
from hmt_ros.sessions.image_inputs import (
    DEPTH,
    DETECTIONS,
    KEYPOINTS,
    KEYPOINTS_3D,
    MASK,
    SOURCES,
)
from hmt_ros.sessions.parameter_file import read_parameter_file
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from hmt_ros.tracking.settings import ACCURATE_BUDGET
from msg_tools import BagReader
from msg_tools.files.error_line import error_line
from msg_tools.files.plain_yaml import load_plain_yaml

FILTER, SMOOTHER, BME = 'filter_node', 'smoother_node', 'bme_node'
PEOPLE_NODE = 'people_node'
# Choices of image times: stamps or log times.
STAMPS, LOG_TIMES = 'stamps', 'log'
# Prefix of parameters in --set, by node.
_PREFIXES = {SMOOTHER: 'smoother.', BME: 'bme.', FILTER: ''}
# Parameters that replay sets itself; their values in a parameter file are ignored.
_OWN_PARAMETERS = ('image_transport', 'autostart')
# Prefixes of parameters that ROS declares for every node.
_ROS_PREFIXES = ('qos_overrides.', 'use_sim_time', 'start_type_description_service')
# Placeholder for the folder of the bag, in options that name a file.
_BAG_PLACEHOLDER = '{bag}'


@dataclass(frozen=True)
class ReplayOptions:
    """Arguments of the command `replay` except the bags; see its help.

    `with_smoother` is false for --no-smoother, `settings` are the values of --set, and an empty
    `bme` selects the model that ships with the package.
    """

    overwrite: bool = False
    quiet: bool = False
    live: bool = False
    with_smoother: bool = True
    keep_going: bool = False
    subject: Path | None = None
    bme: str | None = None
    background: Path | None = None
    body: str | None = None
    config: Sequence[Path] = ()
    settings: Sequence[str] = ()
    seed: int | None = None
    image_topic: str | None = None
    camera_info_topic: str | None = None
    mask_topic: str | None = None
    depth_topic: str | None = None
    keypoints_topic: str | None = None
    namespace: str = ''
    with_images: bool = False
    people: bool = False
    times: str = STAMPS

    def recorded(self, bag: BagReader) -> RecordedInput:
        """The topics of a bag that a replay with these options reads.

        Raises:
            BagError: there are no images or no camera_info, or the choice is ambiguous.
        """
        found = recorded_input(
            bag,
            self.image_topic,
            self.camera_info_topic,
            topics={
                MASK: self.mask_topic,
                DEPTH: self.depth_topic,
                KEYPOINTS: self.keypoints_topic,
            },
            namespace=self.namespace,
        )
        frame = upright_frame(bag, found)
        return replace(found, upright_frame=frame, by_log=self.times == LOG_TIMES)

    def of_bag(self, source: Path) -> ReplayOptions:
        """The options for one bag, with its folder in place of `{bag}` in file names."""
        folder = str(source if source.is_dir() else source.parent)
        return self._renamed(lambda name: name.replace(_BAG_PLACEHOLDER, folder))

    def with_absolute_paths(self) -> ReplayOptions:
        """The options with absolute file names, which are valid in any working directory."""

        def absolute(name: str) -> str:
            return str(Path(name).absolute()) if Path(name).is_file() else name

        config = [file.absolute() for file in self.config]
        return replace(self._renamed(absolute), config=config)

    def _renamed(self, rename: Callable[[str], str]) -> ReplayOptions:
        """The options with `rename` applied to all file names except the files of --config."""

        def path(value: Path | None) -> Path | None:
            return None if value is None else Path(rename(str(value)))

        return replace(
            self,
            subject=path(self.subject),
            background=path(self.background),
            bme=self.bme and rename(self.bme),
            body=self.body and rename(self.body),
        )


class NodeParameters(NamedTuple):
    """Parameters of the nodes; None for a node that does not run.

    `filter` has the parameters of the people node if several people are tracked.
    """

    filter: FilterParameters
    smoother: SmootherParameters | None = None
    bme: BmeParameters | None = None


def parameters_of_bag(source: Path, options: ReplayOptions) -> NodeParameters:
    """Parameters of the nodes for a bag.

    Raises:
        ValueError: bad input.
    """
    with BagReader(source) as bag:
        recorded = options.recorded(bag)
    return node_parameters(options, recorded)


def node_parameters(options: ReplayOptions, recorded: RecordedInput) -> NodeParameters:
    """Parameters of the nodes for the topics of a bag.

    Raises:
        ValueError: unknown parameters or values.
    """
    if options.people:
        return NodeParameters(_people_parameters(options, recorded))
    tracking = _filter_parameters(options, recorded)
    smoothing = _smoother_parameters(options) if options.with_smoother else None
    predicting = None
    started = tracking.subject_file or tracking.use_keypoints
    if options.bme is not None or not started:
        predicting = _bme_parameters(options, recorded, tracking)
        tracking = replace(tracking, use_predictions=True)
    else:
        for text in options.settings:
            if text.startswith(_PREFIXES[BME]):
                raise ValueError(f'--set {text}: nothing is predicted without --bme')
    return NodeParameters(tracking, smoothing, predicting)


def _filter_parameters(options: ReplayOptions, recorded: RecordedInput) -> FilterParameters:
    values = _tracking_values(options, recorded, FILTER)
    if options.subject is not None:
        values['subject_file'] = str(options.subject)
    has_keypoints = recorded.of(KEYPOINTS) is not None
    if (source := values.get('source', OWN_SOURCE)) != OWN_SOURCE:
        detections = recorded.of(DETECTIONS)
        has_keypoints = detections is not None and detections.msgtype == SOURCES.get(source)
    values.setdefault('use_keypoints', has_keypoints)
    has_depth = recorded.of(KEYPOINTS_3D) is not None and values['use_keypoints'] is True
    values.setdefault('use_keypoints_3d', has_depth)
    return with_values(FilterParameters(), values)


def _tracking_values(options: ReplayOptions, recorded: RecordedInput, node: str) -> dict[str, Any]:
    """Parameter values of a tracking node that uses all inputs and transforms in the bag.

    Values given by the user take precedence.
    """
    values = _given_values(options, node)
    given = {
        'random_seed': options.seed,
        'body_model': options.body,
        'background_file': options.background and str(options.background),
    }
    values |= {name: value for name, value in given.items() if value is not None}
    for row in RECORDED_INPUTS:
        if row.name in (MASK, DEPTH):
            values.setdefault(row.parameter, recorded.of(row.name) is not None)
    if 'gravity' not in values:
        values.setdefault('gravity_frame', recorded.upright_frame)
    values.setdefault('fixed_frame', recorded.upright_frame)
    values['image_transport'] = recorded.transport
    values.setdefault('evaluation_budget', ACCURATE_BUDGET)
    return values


def _people_parameters(options: ReplayOptions, recorded: RecordedInput) -> PeopleParameters:
    """Parameters of the people node, which replaces all other nodes."""
    unfit: dict[str, object] = {
        '--live': options.live,
        '--subject': options.subject,
        '--bme': options.bme is not None,
    }
    for option, value in unfit.items():
        if value:
            raise ValueError(f'{option} does not go with --people')
    detections = recorded.of(DETECTIONS)
    sources = {SOURCES[source]: source for source in PeopleParameters.SOURCES}
    if detections is None or detections.msgtype not in sources:
        kinds = ', '.join(SOURCES[x].replace('/msg/', '/') for x in PeopleParameters.SOURCES)
        raise ValueError(f'--people needs the topic detections, of {kinds}: the bag has none')
    values = _tracking_values(options, recorded, PEOPLE_NODE)
    values['source'] = sources[detections.msgtype]
    return with_values(PeopleParameters(), values)


def _smoother_parameters(options: ReplayOptions) -> SmootherParameters:
    values = _given_values(options, SMOOTHER)
    if options.seed is not None:
        values['random_seed'] = options.seed
    if options.body is not None:
        # The name of the body in the messages does not identify its file.
        values['body_model'] = options.body
    return with_values(SmootherParameters(), values)


def _bme_parameters(
    options: ReplayOptions, recorded: RecordedInput, tracking: FilterParameters
) -> BmeParameters:
    values = {
        'background_file': tracking.background_file,
        'use_mask': tracking.use_mask,
        'source': tracking.source,
        'person_id': tracking.person_id,
        'keypoint_scheme': tracking.keypoint_scheme,
        'input_timeout': tracking.input_timeout,
        **_given_values(options, BME),
        'image_transport': recorded.transport,
    }
    if options.bme:
        values['model_file'] = options.bme
    return with_values(BmeParameters(), values)


def _given_values(options: ReplayOptions, node: str) -> dict[str, Any]:
    """Parameter values for a node from --config and --set, by parameter name."""
    values: dict[str, Any] = {}
    for file in options.config:
        # Only the tracking node reads sections for all nodes, because other nodes use some names
        # differently.
        read = read_parameter_file(file, node, by_name=node not in (FILTER, PEOPLE_NODE))
        values.update(
            (name, value)
            for name, value in read.items()
            if not name.startswith(_ROS_PREFIXES) and name not in _OWN_PARAMETERS
        )
    for text in options.settings:
        name, equals, value = text.partition('=')
        owner = next(owner for owner, prefix in _PREFIXES.items() if name.startswith(prefix))
        name = name.removeprefix(_PREFIXES[owner])
        owner = PEOPLE_NODE if owner == FILTER and options.people else owner
        if not equals or name in _OWN_PARAMETERS:
            why = f'{name} is set by replay itself' if equals else 'wanted NAME=VALUE'
            raise ValueError(f'--set {text}: {why}')
        if owner != node:
            continue
        try:
            values[name] = load_plain_yaml(value)
        except ValueError as error:
            raise ValueError(f'--set {text}: {error_line(error)}') from error
        if values[name] is None:
            values[name] = value
    return values
