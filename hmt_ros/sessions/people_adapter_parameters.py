"""Parameters of the node that tells other packages of people.

`hmt_ros/config/people_adapter_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.people_adapter_parameters > \
        hmt_ros/config/people_adapter_node.yaml
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_CONFIGURE,
    NodeParameters,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text


@dataclass(frozen=True)
class PeopleAdapterParameters(NodeParameters):
    """All parameters of the node that tells other packages of people.

    Attributes:
        namespaces: Namespaces of the people whose mixtures are taken, separated by blanks, such as
            '/humans/bodies/p1 /lab/anna'; if empty, the namespace of the node.
        longest_silence: Time without a mixture after which a person is left out, by the stamps of
            the mixtures, s.
    """

    namespaces: str = parameter_field('', NEXT_CONFIGURE)
    longest_silence: float = parameter_field(1.0, AT_ONCE, (0.1, 3600.0))

    def __post_init__(self) -> None:
        for namespace in self.named:
            if not re.fullmatch(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+', namespace):
                raise ValueError(
                    f'namespaces: wanted names such as /humans/bodies/anna, saw {namespace!r}'
                )

    @property
    def named(self) -> tuple[str, ...]:
        """The namespaces, each once."""
        return tuple(dict.fromkeys(self.namespaces.split()))


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('people_adapter_node', PeopleAdapterParameters()))
