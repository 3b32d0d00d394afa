"""Parameters of the smoother node and of its offline replay."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_WINDOW,
    NodeParameters,
    check_choices,
    parameter_field,
)

# Values of `refine_on_images`: when motions are refined on images.
NEVER, ASKED, AT_END = REFINEMENTS = ('never', 'asked', 'end')


@dataclass(frozen=True)
class SmootherParameters(NodeParameters):
    """All parameters of the smoother node.

    Attributes:
        body_model: Body model, a name or a YAML file, that replaces the one named in the mixtures;
            if empty, the mixtures must name a known model.
        fixed_lag: Time by which a smoothed pose lags the newest image, s, at any image rate; it may
            be up to a fifth longer. 0 selects filtering.
        window_length: Number of the newest mixtures that are kept for ~/smooth_window.
        refine_on_images: When up to four distinct motions of the last window_length mixtures are
            refined on the images: 'never', 'asked' (for the answers of ~/smooth_window) or 'end'
            (also at the end of the stream, with the result on trajectory_mixture). Refinement takes
            seconds, and 256 MB at most. The filter must run in the same process (person_node,
            replay) and publish in the camera frame.
        max_hypotheses: Maximum number of motions, the components of smoothed_pose_mixture and
            trajectory_mixture.
        resting_feet: If true, resting feet do not slide between images. The frame of the mixtures
            must then be still (a still camera, or publish_in_fixed_frame of the filter).
        random_seed: Seed of all random numbers; the same mixtures and seed give the same results.
        publish_covariances: If true, trajectory_mixture includes covariances, which make it forty
            times as large.
        publish_tf: If true, the links of the heaviest smoothed pose are published on /tf.
        frame_prefix: Prefix of the link names of the smoothed pose on /tf.
        queue_size: Maximum number of mixtures that wait, for example during ~/smooth_window; the
            oldest are dropped.
    """

    body_model: str = parameter_field('', NEXT_WINDOW)
    fixed_lag: float = parameter_field(0.5, NEXT_WINDOW, (0.0, 3600.0))
    window_length: int = parameter_field(47, AT_ONCE, (1, 10_000))
    refine_on_images: str = parameter_field(ASKED, AT_ONCE)
    max_hypotheses: int = parameter_field(8, NEXT_WINDOW, (1, 1024))
    resting_feet: bool = parameter_field(True, NEXT_WINDOW)
    random_seed: int = parameter_field(0, NEXT_WINDOW, (0, 2**31 - 1))
    publish_covariances: bool = parameter_field(False, AT_ONCE)
    publish_tf: bool = parameter_field(False, AT_ONCE)
    frame_prefix: str = parameter_field('smoothed/', AT_ONCE)
    queue_size: int = parameter_field(100, AT_ONCE, (1, 1000))

    def __post_init__(self) -> None:
        check_choices(self, refine_on_images=REFINEMENTS)
