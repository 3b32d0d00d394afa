"""The node that tells other packages of people, over DDS, with what is installed."""

from importlib.util import find_spec

import pytest

from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters

pytestmark = pytest.mark.ros
PACKAGES = ('people_msgs', 'vision_msgs')


@pytest.mark.parametrize('package', PACKAGES)
def test_people(world_of, likelihoods, package):
    if find_spec(package) is None:
        pytest.skip(f'package {package} is not installed')
    from importlib import import_module

    from hmt_msgs.msg import PoseMixture

    from hmt_ros.nodes.people_adapter_node import PeopleAdapterNode

    one = world_of(PeopleAdapterNode, 'people_adapter_node', {'pose_mixture': PoseMixture})
    one.start()
    kind, topic = {
        'people_msgs': ('People', 'people'),
        'vision_msgs': ('Detection3DArray', 'detections'),
    }[package]
    found = one.hear({topic: getattr(import_module(f'{package}.msg'), kind)})[topic]
    one.send('pose_mixture', likelihoods.message(0))
    one.spin_until(lambda: found)
    assert len(getattr(found[0], topic)) == 1
    one.assert_described(PeopleAdapterParameters())


def test_packages_that_are_not_installed_are_told(world_of):
    if any(find_spec(package) for package in PACKAGES):
        pytest.skip('one of them is installed')
    from hmt_ros.nodes.people_adapter_node import PeopleAdapterNode

    one = world_of(PeopleAdapterNode, 'people_adapter_node', {})
    one.node.start()
    (text,) = one.errors()
    assert 'needs one of the packages people_msgs and vision_msgs, but none is installed' in text
