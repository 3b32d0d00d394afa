"""Mathematics without bodies or images: energies, mixtures, bounded second-order minimisation."""

from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.trust_region import Status

__all__ = ['GaussianMixture', 'Minimum', 'Status', 'minimise']
