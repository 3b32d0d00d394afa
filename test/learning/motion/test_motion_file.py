"""BVH and ASF/AMC: content of small files, and one error line for broken files."""

import contextlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hmt_learning.motion.motion_file import (
    WORLD_FROM_FILE,
    MotionFileError,
    read_motion,
)
from hmt_learning.motion.rig import standard_names

BVH = """HIERARCHY
ROOT base
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT arm
  {
    OFFSET 0 2 0
    CHANNELS 2 Yrotation Xrotation
    End Site
    {
      OFFSET 0 0 0.5
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 0 0 90 0 0 0 0
1 0 0 0 0 90 0 90
"""

ASF = """# a comment
:version 1.10
:name rod
:units
  mass 1.0
  length 0.5
  angle deg
:documentation
  two bones
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name upper
    direction 1 0 0
    length 2
    axis 0 0 90 XYZ
    dof rx rz
    limits (-20 40)
           (-90 90)
  end
  begin
    id 2
    name lower
    direction 0 1 0
    length 1
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root upper
    upper lower
  end
"""

AMC = """#!OML:ASF
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 0 0 0
upper 0 0
2
root 0 0 0 0 90 0
upper 30 90
"""


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture
def rod(tmp_path):
    """Path of an AMC in the same folder as its ASF."""
    write(tmp_path, 'rod.asf', ASF)
    return write(tmp_path, 'rod.amc', AMC)


def test_bvh_by_hand(tmp_path):
    motion = read_motion(write(tmp_path, 'small.bvh', BVH), unit_to_m=0.1)
    assert motion.name == motion.body.name == 'small'
    assert motion.fps == pytest.approx(25)
    assert motion.fps == pytest.approx(25.0)
    assert motion.body.joint_names == ('base', 'arm', 'arm_end')
    assert motion.body.dof_names == (
        'root_tx', 'root_ty', 'root_tz', 'root_z', 'root_x', 'root_y', 'arm_y', 'arm_x',
    )  # fmt: skip
    assert motion.body.segment_lengths == pytest.approx(
        {'base': 0.1 * np.sqrt(14), 'arm': 0.2, 'arm_end': 0.05}
    )
    joints = motion.body.joint_positions(motion.poses)
    # A quarter turn about z lays the arm along -x; its end stays along z.
    np.testing.assert_allclose(joints[0], [[0.1, 0.2, 0.3], [-0.1, 0.2, 0.3], [-0.1, 0.2, 0.35]])
    # A quarter turn about y, then one of the arm about its x: the end points down.
    np.testing.assert_allclose(joints[1], [[0.2, 0.2, 0.3], [0.2, 0.4, 0.3], [0.2, 0.35, 0.3]])


def test_world_is_z_up(tmp_path):
    motion = read_motion(write(tmp_path, 'small.bvh', BVH), unit_to_m=0.1, up_axis='y')
    joints = motion.joint_positions()
    np.testing.assert_allclose(joints[0, 1], [-0.1, -0.3, 0.2])
    np.testing.assert_allclose(motion.joint_positions(['arm'])[0, 0], joints[0, 1])
    with pytest.raises(KeyError, match=r"no joint \['leg'\]"):
        motion.joint_positions(['leg'])


@pytest.mark.parametrize('axis', WORLD_FROM_FILE)
def test_every_up_axis_is_turned_up_by_a_rotation(axis):
    turn = np.array(WORLD_FROM_FILE[axis], dtype=float)
    np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == 1.0
    up = np.zeros(3)
    up['xyz'.index(axis[-1])] = -1.0 if axis[0] == '-' else 1.0
    np.testing.assert_array_equal(turn @ up, [0, 0, 1])


def test_asf_and_amc_by_hand(rod):
    motion = read_motion(rod)
    assert motion.unit_to_m == pytest.approx(0.0508)  # inches / 0.5
    assert motion.fps == 120.0
    body = motion.body
    assert body.joint_names == ('root', 'upper', 'lower', 'lower_end')
    assert body.dof_names == (
        'root_tx', 'root_ty', 'root_tz', 'root_z', 'root_y', 'root_x', 'upper_z', 'upper_x',
    )  # fmt: skip
    assert body.segment_lengths == pytest.approx({'upper': 2 * 0.0508, 'lower': 0.0508})
    np.testing.assert_allclose(body.lower[6:], np.radians([-90, -20]))
    np.testing.assert_allclose(body.upper[6:], np.radians([90, 40]))
    joints = body.joint_positions(motion.poses) / 0.0508
    np.testing.assert_allclose(joints[0], [[1, 2, 3], [1, 2, 3], [3, 2, 3], [3, 3, 3]], atol=1e-12)
    # The axis frame of `upper` is turned by 90 degrees about z: its x is the root's y. Of the two
    # turns the one about x comes first, as in the order XYZ.
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    ry, rz = (
        np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    )
    root = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    knee = root @ rz @ ry @ [2, 0, 0]
    end = knee + root @ rz @ ry @ [0, 1, 0]
    np.testing.assert_allclose(joints[1], [[0, 0, 0], [0, 0, 0], knee, end], atol=1e-12)


def test_limbs_whose_joints_are_not_in_order_are_no_limbs(tmp_path):
    """A person's names in another order: the hip is not above the ankle in the hierarchy."""
    text = BVH.replace('base', 'left_ankle').replace('arm', 'left_hip')
    motion = read_motion(write(tmp_path, 'turned.bvh', text))
    assert {'left_ankle', 'left_hip'} <= {*motion.body.joint_names}
    assert 'left_leg' not in motion.body.skeleton.chains


def sliding(frames):
    """A BVH with position channels at a joint other than the root."""
    return (
        BVH.replace(
            'CHANNELS 2 Yrotation Xrotation',
            'CHANNELS 4 Xposition Yposition Zposition Xrotation',
        ).split('0 0 0 90')[0]
        + frames
    )


@pytest.mark.parametrize('second', ['0 2 0', '0 0 0'])
def test_constant_positions_of_an_inner_joint_are_its_offset(second, tmp_path):
    """Some programs write them equal to OFFSET, others as zero."""
    text = sliding(f'0 0 0 0 0 0 {second} 90\n0 0 0 0 0 0 {second} 0\n')
    motion = read_motion(write(tmp_path, 'inner.bvh', text), unit_to_m=1.0)
    assert motion.body.dimension == 7
    arm = motion.body.joint_positions(motion.poses)[:, 1]
    np.testing.assert_allclose(arm, [[1, 4, 3], [1, 4, 3]])


@pytest.mark.parametrize(('first', 'second'), [('0.1 2 0', '0.1 2.5 0'), ('0.1 0 0', '0.1 0.5 0')])
def test_positions_of_an_inner_joint_that_change_are_translations(first, second, tmp_path):
    text = sliding(f'0 0 0 0 0 0 {first} 90\n0 0 0 0 0 0 {second} 0\n')
    motion = read_motion(write(tmp_path, 'inner.bvh', text), unit_to_m=1.0)
    assert motion.body.dof_names[6:] == ('arm_tx', 'arm_ty', 'arm_tz', 'arm_x')
    arm = motion.body.joint_positions(motion.poses)[:, 1]
    np.testing.assert_allclose(arm, [[1.1, 4, 3], [1.1, 4.5, 3]])


@pytest.mark.parametrize(('written', 'height'), [(0.9, 1.0), (0.0, 1.0), (0.1, 1.1)])
def test_root_positions_stand_instead_of_an_offset_or_add_to_it(written, height, tmp_path):
    """Programs differ; numbers as large as the offset must replace it."""
    text = BVH.replace('OFFSET 1 2 3', 'OFFSET 0 1 0').split('0 0 0 90')[0]
    text = text.replace('Frames: 2', 'Frames: 1') + f'5 {written} 7 0 0 0 0 0\n'
    motion = read_motion(write(tmp_path, 'root.bvh', text), unit_to_m=1.0)
    expected = [5, written if written > 0.5 else height, 7]
    np.testing.assert_allclose(motion.body.joint_positions(motion.poses)[0, 0], expected)


BROKEN = {
    'one line': ('HIERARCHY ROOT a { ' + 'OFFSET 0 0 0 ' * 5001, ':1: 20008 words in a line'),
    'long name': (BVH.replace('arm', 'a' * 201), ':6: saw JOINT with a name of 201 characters'),
    'lines': ('\n' * 11_000_000, '11000000 lines in 11000000 bytes are too many'),
    'numbers': (BVH.replace('Frames: 2', 'Frames: 9999999'), 'wanted 30000000 numbers at most'),
    'empty': ('', r':0: the file ends, wanted HIERARCHY'),
    'something else': ('{"a": 1}', r":1: saw '{\"a\": 1}', wanted HIERARCHY"),
    'no motion': (BVH.split('MOTION')[0], r'the file ends, wanted MOTION'),
    'cut in the hierarchy': (BVH.split('  OFFSET 0 2')[0], r'the file ends, wanted a closing }'),
    'cut in the header': (BVH.split('Frame Time')[0], 'wanted Frames: and Frame Time:'),
    'cut in the frames': (BVH.rsplit('1 0 0', 1)[0], r':19: saw 1 frames, wanted 2'),
    'cut in a frame': (BVH[:-6], r":20: frame 2: saw '1 0 0 0 0 90', wanted 8 finite numbers"),
    'too many frames': (BVH + '0 0 0 0 0 0 0 0\n', r'saw 3 frames, wanted 2'),
    'too many numbers': (BVH.replace('90 0 0 0 0', '90 0 0 0 0 0'), r':19: frame 1: saw'),
    'too few and too many': (
        BVH.replace('0 0 0 90 0 0 0 0\n1', '0 0 0 90 0 0 0 0 1\n'), r':19: frame 1'
    ),
    'a word in a frame': (BVH.replace('90 0 0', '90 O 0', 1), r":19: frame 1: saw '0 0 0 90 O 0"),
    'not a number': (BVH.replace('90 0 0', '90 nan 0', 1), r':19: frame 1: saw .* finite numbers'),
    'infinite': (BVH.replace('90 0 0', '90 1e999 0', 1), r':19: frame 1'),
    'NaN offset': (BVH.replace('OFFSET 1 2 3', 'OFFSET 1 nan 3'), r":4: OFFSET: saw '1 nan 3'"),
    'two offsets': (BVH.replace('OFFSET 1 2 3', 'OFFSET 1 2'), r':4: OFFSET: .* wanted 3 finite'),
    'no offset': (BVH.replace('  OFFSET 1 2 3\n', ''), r'base \(line 2\) has no OFFSET'),
    'unknown channel': (
        BVH.replace('2 Yrotation', '2 Wrotation'), r":9: arm: unknown channel 'Wrotation'"
    ),
    'a channel twice': (
        BVH.replace('2 Yrotation', '2 Xrotation'), r":9: arm: twice the channel 'Xrotation'"
    ),
    'fewer channels than counted': (BVH.replace('CHANNELS 2', 'CHANNELS 3'), r':9: saw'),
    'more channels than counted': (BVH.replace('CHANNELS 2', 'CHANNELS 1'), r":9: saw 'CHANNELS 1"),
    'channels without count': (BVH.replace('CHANNELS 2', 'CHANNELS'), r':9: saw .* their number'),
    'a negative count': (BVH.replace('CHANNELS 2', 'CHANNELS -2'), r':9: saw'),
    'channels of a tip': (
        BVH.replace('OFFSET 0 0 0.5', 'OFFSET 0 0 0.5\nCHANNELS 1 Xrotation'), r':13: arm_end'
    ),
    'channels twice': (
        BVH.replace('CHANNELS 2', 'CHANNELS 1 Zrotation\nCHANNELS 2'), r':10: arm: CHANNELS a sec'
    ),
    'no channels': (
        BVH.replace('CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation', '')
        .replace('CHANNELS 2 Yrotation Xrotation', ''),
        'no joint has CHANNELS',
    ),
    'two roots': (BVH.replace('JOINT arm', 'ROOT arm'), r':6: saw .* one ROOT'),
    'no root': (BVH.replace('ROOT base', 'JOINT base'), r":2: saw 'JOINT base'"),
    'no name': (BVH.replace('JOINT arm', 'JOINT'), r':6: saw JOINT with a name of 0 characters'),
    'a name twice': (BVH.replace('JOINT arm', 'JOINT base'), r":6: a second joint 'base'"),
    'a joint in a tip': (
        BVH.replace('OFFSET 0 0 0.5', 'OFFSET 0 0 0.5\nJOINT more\n{'), r':13: .* End Site'
    ),
    'a brace too many': (BVH.replace('}\nMOTION', '}\n}\nMOTION'), r":16: saw '}'"),
    'no brace': (BVH.replace('ROOT base\n{', 'ROOT base'), r":3: saw 'OFFSET 1 2 3', wanted {"),
    'no frames': (BVH.replace('Frames: 2', 'Frames: 0'), r':17: saw 0 frames, wanted one at least'),
    'negative frames': (BVH.replace('Frames: 2', 'Frames: -3'), r':17: saw -3 frames'),
    'half a frame': (BVH.replace('Frames: 2', 'Frames: 1.5'), r':17: saw 1.5 frames'),
    'more frames than memory': (
        BVH.replace('Frames: 2', 'Frames: 999999999999'), r':17: 999999999999 frames of 8 channels'
    ),
    'negative frame time': (BVH.replace('0.04', '-0.04'), r':18: frame time -0.04 s'),
    'no frame time': (BVH.replace('0.04', '0'), r':18: frame time 0 s, wanted more than 0'),
    'a word as frame time': (BVH.replace('0.04', 'fast'), r":18: Frame Time: saw 'fast'"),
    'binary': (BVH.replace('90', '9\0'), r':19: binary data'),
}  # fmt: skip


@pytest.mark.parametrize('case', BROKEN)
def test_a_broken_bvh_is_refused_with_one_line(case, tmp_path):
    text, pattern = BROKEN[case]
    path = write(tmp_path, 'broken.bvh', text)
    with pytest.raises(MotionFileError, match=pattern) as caught:
        read_motion(path)
    assert '\n' not in str(caught.value)
    assert str(path) in str(caught.value)


BROKEN_ASF = {
    'empty': ('', r'the file ends, wanted :root'),
    'something else': ('HIERARCHY', r":1: saw 'HIERARCHY', wanted :version"),
    'no hierarchy': (ASF.split(':hierarchy')[0], r'wanted :hierarchy'),
    'cut in a bone': (ASF.split('    id 2')[0] + ':hierarchy\n', r':26: a bone without end'),
    'bone without begin': (ASF.replace('  begin\n    id 1', '    id 1'), r":16: saw 'id 1'"),
    'bone in a bone': (ASF.replace('  end\n  begin\n    id 2', '  begin\n    id 2'), r'begin in'),
    'no direction': (ASF.replace('    direction 1 0 0\n', ''), r':16: bone upper has no direction'),
    'no length': (ASF.replace('    length 2\n', ''), r':16: bone upper has no length'),
    'no name': (ASF.replace('    name upper\n', ''), r':16: bone \? has no name'),
    'a NaN length': (ASF.replace('length 2', 'length nan'), r":20: length: saw 'nan'"),
    'unknown channel': (ASF.replace('dof rx rz', 'dof rx rw'), r":22: saw channels 'rx rw'"),
    'a channel twice': (ASF.replace('dof rx rz', 'dof rx rx'), r":22: saw channels 'rx rx'"),
    'a bone that slides': (ASF.replace('dof rx rz', 'dof rx tz'), r':22: upper: saw rx tz'),
    'limits for another count': (ASF.replace('dof rx rz', 'dof rx'), r'2 limits for 1 degrees'),
    'limits the wrong way round': (ASF.replace('(-20 40)', '(40 -20)'), r"23: saw limits '40 -"),
    'limits that are words': (ASF.replace('(-20 40)', '(low high)'), r":23: saw limits 'low high'"),
    'an unknown order': (ASF.replace('90 XYZ', '90 XYX'), r":21: saw 'XYX', wanted an order"),
    'an unknown key': (ASF.replace('    id 2', '    idea 2'), r":27: saw 'idea', wanted id, name"),
    'an unknown key of the root': (ASF.replace('orientation', 'angle'), r":14: saw 'angle'"),
    'an unknown angle': (ASF.replace('angle deg', 'angle grad'), r":7: saw 'angle grad'"),
    'a negative unit': (ASF.replace('length 0.5', 'length -1'), r':6: length unit -1'),
    'a bone twice': (ASF.replace('name lower', 'name upper'), r":26: a second bone 'upper'"),
    'an unknown bone': (ASF.replace('upper lower\n', 'upper foot\n'), r"unknown bone 'foot'"),
    'a lost bone': (ASF.replace('    upper lower\n', ''), r':26: bone lower is not in'),
    'two parents': (
        ASF.replace('upper lower\n', 'upper lower\n    root lower\n'), r'lower has a parent already'
    ),
    'a loop': (ASF.replace('root upper\n', 'lower upper\n'), r'lower has children before'),
    'binary': (ASF.replace('rod', 'r\0d'), r':3: binary data'),
}  # fmt: skip


@pytest.mark.parametrize('case', BROKEN_ASF)
def test_a_broken_asf_is_refused_with_one_line(case, rod):
    text, pattern = BROKEN_ASF[case]
    path = rod.with_suffix('.asf')
    path.write_text(text)
    with pytest.raises(MotionFileError, match=pattern) as caught:
        read_motion(rod)
    assert '\n' not in str(caught.value)
    assert str(path) in str(caught.value)


BROKEN_AMC = {
    'empty': ('', r':0: the file ends, wanted frames'),
    'header alone': (':DEGREES\n', r':1: the file ends, wanted frames'),
    'no frame number': (AMC.replace('\n1\n', '\n'), r":4: saw 'root 1 2 3 0 0 0', wanted frame 1"),
    'a frame missing': (AMC.replace('\n2\n', '\n3\n'), r':7: frame 3, wanted frame 2'),
    'a bone missing': (AMC.replace('upper 0 0\n', ''), r':6: the frame before lacks upper'),
    'cut in the last frame': (AMC.rsplit('upper', 1)[0], r'the last frame lacks upper'),
    'cut in a line': (AMC[:-4], r":9: bone upper: saw '30', wanted 2 finite numbers"),
    'too many numbers': (AMC.replace('upper 0 0', 'upper 0 0 0'), r':6: bone upper'),
    'a NaN': (AMC.replace('upper 0 0', 'upper 0 nan'), r":6: bone upper: saw '0 nan'"),
    'a word': (AMC.replace('upper 0 0', 'upper 0 zero'), r":6: bone upper: saw '0 zero'"),
    'an unknown bone': (AMC.replace('upper 0', 'leg 0'), r":6: bone 'leg' is not in the skeleton"),
    'a bone without channels': (AMC + 'lower 1\n', r":10: bone 'lower' is not in the skeleton"),
    'a bone twice': (AMC.replace('upper 0 0', 'upper 0 0\nupper 0 0'), r":7: .*twice in one frame"),
    'binary': (AMC.replace('30', '\0'), r':9: binary data'),
}  # fmt: skip


@pytest.mark.parametrize('case', BROKEN_AMC)
def test_a_broken_amc_is_refused_with_one_line(case, rod):
    text, pattern = BROKEN_AMC[case]
    rod.write_text(text)
    with pytest.raises(MotionFileError, match=pattern) as caught:
        read_motion(rod)
    assert '\n' not in str(caught.value)
    assert str(rod) in str(caught.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(data=st.data())
def test_damaged_files_are_read_or_refused(data, rod):
    """For any cut, doubled or overwritten bytes, the only error is MotionFileError."""
    name, text = data.draw(st.sampled_from([('x.bvh', BVH), ('rod.asf', ASF), ('rod.amc', AMC)]))
    start = data.draw(st.integers(0, len(text)))
    stop = data.draw(st.integers(start, min(start + 30, len(text))))
    put = data.draw(
        st.sampled_from(['', '{', '}', '\n', '0', 'nan', '-', '\x80', text[start:stop] * 2])
    )
    rod.with_suffix('.asf').write_text(ASF)
    rod.write_text(AMC)
    path = rod.with_name(name)
    path.write_text(text[:start] + put + text[stop:], encoding='utf-8')
    with contextlib.suppress(MotionFileError):
        motion = read_motion(path if name != 'rod.asf' else rod)
        assert np.isfinite(motion.body.joint_positions(motion.poses)).all()


# ------------------------------------------------------------------------------ whose names


def rig(prefix, spine, arm, leg, sides):
    """Names and parents of a rig; `*` in a name is its side."""
    names, parents = [], []

    def chain(start, joints, side=''):
        for joint in joints:
            names.append(prefix + joint.replace('*', side))
            parents.append(start)
            start = len(names) - 1

    chain(-1, spine)
    for side in sides:
        chain(len(spine) - 3, arm, side)
        chain(0, leg, side)
    return names, parents


RIGS = {
    'cmu asf': rig(
        '', ['root', 'lowerback', 'upperback', 'thorax', 'lowerneck', 'head'],
        ['*clavicle', '*humerus', '*radius', '*wrist', '*hand', '*fingers'],
        ['*hipjoint', '*femur', '*tibia', '*foot', '*toes'], ('l', 'r'),
    ),
    'motionbuilder': rig(
        '', ['Hips', 'Spine', 'Spine1', 'Neck', 'Head'],
        ['*Shoulder', '*Arm', '*ForeArm', '*Hand', '*HandMiddle1'],
        ['*UpLeg', '*Leg', '*Foot', '*ToeBase'], ('Left', 'Right'),
    ),
    'mixamo': rig(
        'mixamorig:', ['Hips', 'Spine', 'Spine2', 'Neck', 'Head'],
        ['*Shoulder', '*Arm', '*ForeArm', '*Hand', '*HandMiddle1'],
        ['*UpLeg', '*Leg', '*Foot', '*ToeBase'], ('Left', 'Right'),
    ),
    'biovision': rig(
        '', ['Hips', 'Chest', 'Neck', 'Head'],
        ['*Collar', '*Shoulder', '*Elbow', '*Wrist', '*Wrist_end'],
        ['*Hip', '*Knee', '*Ankle', '*Toe'], ('Left', 'Right'),
    ),
    'daz': rig(
        '', ['hip', 'abdomen', 'chest', 'neck', 'head'],
        ['*Collar', '*Shldr', '*ForeArm', '*Hand', '*Mid1'],
        ['*Buttock', '*Thigh', '*Shin', '*Foot', '*Foot_end'], ('l', 'r'),
    ),
    'character creator': rig(
        'CC_Base_', ['Hip', 'Waist', 'Spine02', 'NeckTwist01', 'Head'],
        ['*_Clavicle', '*_Upperarm', '*_Forearm', '*_Hand', '*_Hand_end'],
        ['*_Thigh', '*_Calf', '*_Foot', '*_ToeBase'], ('L', 'R'),
    ),
    'unreal': rig(
        '', ['pelvis', 'spine_01', 'neck_01', 'head'],
        ['clavicle_*', 'upperarm_*', 'lowerarm_*', 'hand_*', 'middle_01_*'],
        ['thigh_*', 'calf_*', 'foot_*', 'ball_*'], ('l', 'r'),
    ),
    'blender': rig(
        '', ['hips', 'spine', 'neck', 'head'],
        ['shoulder.*', 'upper_arm.*', 'forearm.*', 'hand.*', 'hand_end.*'],
        ['thigh.*', 'shin.*', 'foot.*', 'toe.*'], ('L', 'R'),
    ),
}  # fmt: skip
STANDARD = ['hip', 'knee', 'ankle', 'toe', 'shoulder', 'elbow', 'wrist', 'hand']


@pytest.mark.parametrize('maker', RIGS)
def test_joints_of_known_rigs_get_standard_names(maker):
    names, parents = RIGS[maker]
    result = standard_names(names, parents)
    everything = {f'{side}_{j}' for side in ('left', 'right') for j in STANDARD}
    assert everything | {'pelvis', 'neck', 'head'} <= set(result)
    assert len(set(result)) == len(result) == len(names)
    for side, limb in (
        (s, limb) for s in ('left', 'right') for limb in (STANDARD[:4], STANDARD[4:])
    ):
        for a, b in pairwise(limb):
            assert parents[result.index(f'{side}_{b}')] == result.index(f'{side}_{a}')
    left = (
        names[result.index('left_knee')].lower().removeprefix('mixamorig:').removeprefix('cc_base_')
    )
    assert left.startswith('l') or left.endswith('l')


def person_bvh(unit, up):
    """A BVH of a person of about 1.75 m who stands along an axis, with MotionBuilder's names."""
    axes = [(up + 1) % 3, (up + 2) % 3, up]

    def offset(x, y, z):
        v = np.zeros(3)
        v[axes] = np.array([x, y, z]) / unit
        return ' '.join(f'{c:.9g}' for c in v)

    def joint(name, place, *children):
        inside = ''.join(children) or f'End Site\n{{\nOFFSET {offset(0, 0.05, 0)}\n}}\n'
        channels = 'CHANNELS 3 Zrotation Xrotation Yrotation'
        return f'JOINT {name}\n{{\nOFFSET {offset(*place)}\n{channels}\n{inside}}}\n'

    limbs = []
    for side, sign in (('Left', 1), ('Right', -1)):
        foot = joint(f'{side}Foot', (0, 0, -0.42), joint(f'{side}ToeBase', (0, 0.13, -0.05)))
        leg = joint(f'{side}Leg', (0, 0, -0.43), foot)
        limbs.append(joint(f'{side}UpLeg', (0.1 * sign, 0, -0.08), leg))
    arms = []
    for side, sign in (('Left', 1), ('Right', -1)):
        hand = joint(f'{side}Hand', (0, 0, -0.25))
        arms.append(
            joint(f'{side}Arm', (0.18 * sign, 0, 0), joint(f'{side}ForeArm', (0, 0, -0.29), hand))
        )
    neck = joint('Neck', (0, 0, 0.25), joint('Head', (0, 0, 0.15)))
    spine = joint('Spine', (0, 0, 0.2), neck, *(a.replace('(', '') for a in arms))
    root = 'CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation'
    head = f'HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\n{root}\n{spine}{"".join(limbs)}}}\n'
    count = head.count('rotation')
    frame = ' '.join(['0'] * (count + 3))
    return f'{head}MOTION\nFrames: 1\nFrame Time: 0.02\n{frame}\n'


@pytest.mark.parametrize('up', [0, 1, 2])
@pytest.mark.parametrize('unit', [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45])
def test_units_and_up_axis_are_guessed(unit, up, tmp_path):
    motion = read_motion(write(tmp_path, 'person.bvh', person_bvh(unit, up)))
    assert motion.unit_to_m == pytest.approx(unit)
    assert motion.body.segment_lengths['LeftLeg'] == pytest.approx(0.43)
    place = dict(zip(motion.body.joint_names, motion.joint_positions()[0]))
    assert place['head'][2] - place['left_ankle'][2] == pytest.approx(1.53)
    assert 1.6 < motion.body.stature < 1.9
    assert motion.body.with_stature(1.5).stature == pytest.approx(1.5)
    assert [motion.body.skeleton.segment_names[s] for s in motion.body.chains['left_arm']] == [
        'LeftArm', 'LeftForeArm', 'LeftHand',
    ]  # fmt: skip
