"""Parameters of the node that tells other packages of people."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_CONFIGURE,
    NodeParameters,
    namespaces_in,
    parameter_field,
)


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
        namespaces_in(self.namespaces)

    @property
    def named(self) -> tuple[str, ...]:
        """The namespaces, each once."""
        return namespaces_in(self.namespaces)
