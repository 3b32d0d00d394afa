"""Mathematics without bodies or images: energies, mixtures, bounded second-order minimisation."""

from hmt_ros.inference.bounded_newton import Minimum, Status, minimise
from hmt_ros.inference.mixture import GaussianMixture

__all__ = ['GaussianMixture', 'Minimum', 'Status', 'minimise']
