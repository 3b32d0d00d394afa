"""Forward/backward flips of limbs and trunk, and their best combinations (KJS 3)."""

from hmt_ros.flips.interpretation_tree import enumerate_flips

__all__ = ['enumerate_flips']
