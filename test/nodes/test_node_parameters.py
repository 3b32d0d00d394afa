"""Unused parameters are named, and so are files for another node."""

from functools import partial

import pytest

pytestmark = pytest.mark.ros


def test_unknown_names_from_command_line_and_file(world_of, stub_tracker, tmp_path):
    from hmt_ros.nodes.filter_node import FilterNode

    file = tmp_path / 'own.yaml'
    file.write_text(
        '/**/filter_node:\n  ros__parameters:\n    subjekt_file: a\n    use_mask: true\n'
    )
    quality = 'qos_overrides./{}.subscription.reliability:=reliable'
    arguments = [
        '--ros-args', '-p', 'max_hypothesis:=3', '-p', 'use_sim_time:=false',
        '-p', quality.format('imgae'), '-p', quality.format('camera_info'),
        '--params-file', str(file),
    ]  # fmt: skip
    one = world_of(partial(FilterNode, cli_args=arguments), 'filter_node', {})
    one.node.start()
    assert one.session.parameters.use_mask
    assert one.warnings() == [
        "unknown parameter 'max_hypothesis'; did you mean 'max_hypotheses'?",
        "unknown parameter 'subjekt_file'; did you mean 'subject_file'?",
        "unknown parameter 'qos_overrides./imgae.subscription.reliability'; did you mean "
        "'qos_overrides./image.subscription.reliability'?",
    ]


@pytest.mark.parametrize(
    ('section', 'meant'),
    [
        ('filter_nod', True),
        ('/p1/filter_node', True),
        ('/**/filter_node', False),
        ('filter_node', False),
        ('/**', False),
        ('/*', False),
        # Nodes of this or another package: the file is for several nodes.
        ('smoother_node', False),
        ('/camera/driver', False),
    ],
)
def test_a_file_whose_sections_do_not_match(section, meant, tmp_path):
    from hmt_ros.nodes.node_parameters import files_for_others

    file = tmp_path / 'own.yaml'
    file.write_text(f'{section!r}:\n  ros__parameters:\n    use_mask: true\n')
    texts = files_for_others(['--ros-args', '--params-file', str(file)], '/filter_node')
    assert len(texts) == meant
    if meant:
        wanted = f"its parameters are for '/{section.strip('/')}', and this node is '/filter_node'"
        assert texts[0].startswith(f'{file}: {wanted}: none is used; name the section ')


def test_unknown_names_and_a_file_for_another_namespace_are_told_by_the_node(executable, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text('/p1/filter_node:\n  ros__parameters:\n    use_mask: true\n')
    arguments = ['-p', 'max_hypothesis:=3', '-p', 'autostart:=false', '--params-file', str(file)]
    lines = executable('filter_node', *arguments).stop_at('its parameters')
    first, second = (line.partition('[filter_node]: ')[2] for line in lines if '[WARN]' in line)
    assert first.startswith("unknown parameter 'max_hypothesis'")
    assert second.strip().endswith("none is used; name the section '/**/filter_node'")


@pytest.mark.parametrize(
    ('values', 'resets'),
    [
        ({}, False),
        ({'use_sim_time': True}, True),
        ({'use_sim_time': True, 'reset_on_time_jump': False}, False),
    ],
)
def test_a_jump_of_simulated_time_resets_unless_told_otherwise(world_of, values, resets):
    from hmt_ros.nodes.smoother_node import SmootherNode

    one = world_of(SmootherNode, 'smoother_node', {}, **values)
    assert one.node.get_parameter('reset_on_time_jump').value is resets
    assert one.node._settings.reset_on_time_jump is resets
