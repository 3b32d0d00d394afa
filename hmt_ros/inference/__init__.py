"""Mathematics independent of bodies and images: energies, mixtures, bounded minimisation."""

from hmt_ros.inference.bounded_newton import Minimum, Status, minimise
from hmt_ros.inference.mixture import GaussianMixture

__all__ = ['GaussianMixture', 'Minimum', 'Status', 'minimise']
