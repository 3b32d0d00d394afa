"""Renders the avatar in a room with Blender (package bpy): one PNG per image, and empty.png.

    python render.py MPFB2 MOTION.npz FOLDER

Shirt, trousers and shoes of the person are parts of the skin, shifted along its normals.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import mathutils
import numpy as np
from avatar import Avatar

SAMPLES = 8
SEED = 5


def main(argv: list[str]) -> int:
    """Renders all images of a motion."""
    avatar, motion, folder = Avatar(Path(argv[0])), np.load(argv[1]), Path(argv[2])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    furnish(np.random.default_rng(SEED), motion)
    light()
    parts = dress(avatar)
    settings(motion)
    for part, _, _ in parts:
        part.hide_render = True
    shoot(folder / 'empty.png')
    for number, vertices in enumerate(motion['vertices'].astype(np.float64)):
        normals = avatar.normals(vertices)
        for part, which, offsets in parts:
            part.hide_render = False
            places = vertices[which] + offsets[:, None] * normals[which]
            if part.name == 'shoes':
                places[:, 2] = np.maximum(places[:, 2], 0.013)
            part.data.vertices.foreach_set('co', places.ravel().astype(np.float32))
            part.data.update()
        shoot(folder / f'{number:04d}.png')
    return 0


def settings(motion) -> None:
    """Sets up the camera and the renderer."""
    scene = bpy.context.scene
    camera = bpy.data.cameras.new('camera')
    camera.sensor_fit, camera.angle_x = 'HORIZONTAL', 2.0 * float(motion['half_angle'])
    thing = bpy.data.objects.new('camera', camera)
    scene.collection.objects.link(thing)
    distance, height, _ = motion['place']
    place = np.eye(4)
    # Blender's camera looks along its own -z, with y up.
    place[:3, :3] = motion['rotation'].T @ np.diag([1.0, -1.0, -1.0])
    place[:3, 3] = 0.0, distance, height
    thing.matrix_world = mathutils.Matrix(place.tolist())
    scene.camera = thing
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device = 'CYCLES', 'CPU'
    cycles.samples, cycles.use_denoising, cycles.max_bounces = SAMPLES, True, 3
    render.resolution_x, render.resolution_y = motion['size'].tolist()
    render.resolution_percentage = 100
    render.use_persistent_data = True
    render.image_settings.file_format = 'PNG'
    scene.view_settings.view_transform = 'Standard'


def shoot(path: Path) -> None:
    """Renders one image."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def material(name, colour, rough=0.6, noise=0.0, scale=20.0, *, painted=False, skin=False):
    """A material with one colour, or with vertex colours, and some noise."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes['Principled BSDF']
    surface.inputs['Roughness'].default_value = rough
    surface.inputs['Base Color'].default_value = (*colour, 1.0)
    if skin:
        surface.inputs['Subsurface Weight'].default_value = 0.12
        surface.inputs['Subsurface Scale'].default_value = 0.01
    source = None
    if painted:
        paint = nodes.new('ShaderNodeVertexColor')
        paint.layer_name = 'colour'
        source = paint.outputs['Color']
    if noise:
        grain, place = nodes.new('ShaderNodeTexNoise'), nodes.new('ShaderNodeTexCoord')
        grain.inputs['Scale'].default_value, grain.inputs['Detail'].default_value = scale, 6
        links.new(place.outputs['Object'], grain.inputs['Vector'])
        spread, mix = nodes.new('ShaderNodeMapRange'), nodes.new('ShaderNodeMix')
        spread.inputs['To Min'].default_value = 0.3
        spread.inputs['To Max'].default_value = 1.5
        links.new(grain.outputs['Fac'], spread.inputs['Value'])
        mix.data_type, mix.blend_type = 'RGBA', 'MULTIPLY'
        mix.inputs['Factor'].default_value = noise
        mix.inputs['A'].default_value = (*colour, 1.0)
        if source is not None:
            links.new(source, mix.inputs['A'])
        links.new(spread.outputs['Result'], mix.inputs['B'])
        source = mix.outputs['Result']
    if source is not None:
        links.new(source, surface.inputs['Base Color'])
    return made


def boards():
    """The material of the floor: wooden boards with grain."""
    made = bpy.data.materials.new('floor')
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    place, bricks = nodes.new('ShaderNodeTexCoord'), nodes.new('ShaderNodeTexBrick')
    for name, value in (
        ('Scale', 1.0), ('Brick Width', 1.1), ('Row Height', 0.14), ('Mortar Size', 0.004),
        ('Color1', (0.36, 0.22, 0.12, 1)), ('Color2', (0.28, 0.165, 0.09, 1)),
        ('Mortar', (0.1, 0.06, 0.03, 1)),
    ):  # fmt: skip
        bricks.inputs[name].default_value = value
    links.new(place.outputs['Object'], bricks.inputs['Vector'])
    grain, stretch = nodes.new('ShaderNodeTexNoise'), nodes.new('ShaderNodeMapping')
    grain.inputs['Scale'].default_value, grain.inputs['Detail'].default_value = 6, 8
    stretch.inputs['Scale'].default_value = (0.6, 9, 1)
    links.new(place.outputs['Object'], stretch.inputs['Vector'])
    links.new(stretch.outputs['Vector'], grain.inputs['Vector'])
    mix = nodes.new('ShaderNodeMix')
    mix.data_type, mix.blend_type = 'RGBA', 'OVERLAY'
    mix.inputs['Factor'].default_value = 0.5
    links.new(bricks.outputs['Color'], mix.inputs['A'])
    links.new(grain.outputs['Color'], mix.inputs['B'])
    surface = nodes['Principled BSDF']
    surface.inputs['Roughness'].default_value = 0.42
    links.new(mix.outputs['Result'], surface.inputs['Base Color'])
    return made


def box(size, place, look, turn=0.0, bevel=0.01) -> None:
    """Adds a box with round edges."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=place, rotation=(0, 0, turn))
    thing = bpy.context.object
    thing.scale = size
    bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
    if bevel:
        modifier = thing.modifiers.new('bevel', 'BEVEL')
        modifier.width, modifier.segments = bevel, 2
    thing.data.materials.append(look)


def cylinder(radius, height, place, look, top=None) -> None:
    """Adds a cylinder, or a cone with another radius at its top."""
    bpy.ops.mesh.primitive_cone_add(
        radius1=radius, radius2=top or radius, depth=height, location=place, vertices=32
    )
    bpy.context.object.data.materials.append(look)
    bpy.ops.object.shade_smooth()


def furnish(rng: np.random.Generator, motion) -> None:
    """Adds a living room: floor, walls, shelf with books, sofa, picture, plant, rug and table."""
    bpy.ops.mesh.primitive_plane_add(size=14)
    bpy.context.object.data.materials.append(boards())
    wall, white = material('wall', (0.62, 0.60, 0.55), 0.9, 0.08, 3), material('white', (0.75,) * 3)
    dark, oak = material('dark', (0.05, 0.045, 0.04)), material('oak', (0.42, 0.27, 0.14), 0.5, 0.5)
    box((9, 0.1, 3), (0, -2.2, 1.5), wall, bevel=0)
    box((0.1, 9, 3), (-3.4, 1.5, 1.5), wall, bevel=0)
    box((9, 0.02, 0.1), (0, -2.14, 0.05), white)
    for height in (0.05, 0.5, 0.95, 1.4, 1.85):
        box((1.0, 0.32, 0.03), (-2.0, -1.95, height), oak)
    for x in (-2.5, -1.5):
        box((0.03, 0.32, 1.85), (x, -1.95, 0.95), oak)
    for height in (0.065, 0.515, 0.965, 1.415):
        x = -2.45
        while x < -1.6:
            wide, tall = rng.uniform(0.025, 0.06), rng.uniform(0.2, 0.33)
            if rng.random() < 0.85:
                look = material('book', rng.uniform(0.03, 0.5, 3) * rng.uniform(0.3, 1))
                box((wide, 0.2, tall), (x + wide / 2, -1.9, height + tall / 2), look, bevel=0.003)
            x += wide + 0.003
    fabric = material('sofa', (0.10, 0.17, 0.22), 0.95, 0.5, 60)
    box((1.7, 0.8, 0.42), (1.75, -1.6, 0.24), fabric, bevel=0.06)
    box((1.7, 0.22, 0.85), (1.75, -1.95, 0.45), fabric, bevel=0.08)
    for x in (0.85, 2.65):
        box((0.2, 0.8, 0.6), (x, -1.6, 0.32), fabric, bevel=0.06)
    cushion = material('cushion', (0.55, 0.25, 0.07), 0.9, 0.4, 30)
    box((0.45, 0.15, 0.42), (1.3, -1.62, 0.62), cushion, 0.2, 0.06)
    box((0.9, 0.03, 0.6), (1.6, -2.13, 1.65), dark)
    paint = material('paint', (0.35, 0.42, 0.5), 0.6, 0.95, 4)
    box((0.82, 0.035, 0.52), (1.6, -2.13, 1.65), paint, bevel=0)
    cylinder(0.16, 0.3, (-0.85, -1.85, 0.15), material('pot', (0.5, 0.2, 0.12), 0.7), 0.2)
    leaf = material('leaf', (0.05, 0.16, 0.04), 0.5, 0.5, 10)
    for _ in range(26):
        angle, long, up = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.7), rng.uniform(0.5, 1.2)
        out = 0.3 * long
        place = (-0.85 + out * math.cos(angle), -1.85 + out * math.sin(angle), 0.35 + up * long)
        bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, location=place)
        thing = bpy.context.object
        thing.scale = (0.05, 0.015, 0.4 * long)
        thing.rotation_euler = (*rng.uniform(-0.6, 0.6, 2), angle)
        thing.data.materials.append(leaf)
        bpy.ops.object.shade_smooth()
    rug = material('rug', (0.33, 0.12, 0.10), 0.95, 0.6, 25)
    box((2.6, 1.7, 0.012), (0.2, 0.1, 0.006), rug, bevel=0.004)
    box((0.7, 0.7, 0.04), (2.3, -0.2, 0.45), oak)
    for x in (2.0, 2.6):
        for y in (-0.5, 0.1):
            box((0.05, 0.05, 0.44), (x, y, 0.22), dark)
    cylinder(0.04, 0.1, (2.2, -0.1, 0.52), white)
    # The desk has a front that hides legs.
    (x, y), wide, deep = motion['desk'].tolist(), 1.1, 0.6
    box((wide, deep, 0.03), (x, y, 0.735), oak, bevel=0.005)
    box((wide - 0.06, 0.02, 0.56), (x, y + 0.24, 0.44), oak, bevel=0)
    for side in (-0.53, 0.53):
        box((0.03, 0.56, 0.72), (x + side, y, 0.36), oak, bevel=0)
    x, y, seat = motion['stool'].tolist()
    cylinder(0.17, 0.04, (x, y, seat - 0.02), dark)
    for aside in (-0.1, 0.1):
        for ahead in (-0.1, 0.1):
            cylinder(0.015, seat - 0.04, (x + aside, y + ahead, 0.5 * seat - 0.02), dark)


def light() -> None:
    """Adds a window beside the camera, a lamp above, and the light of the sky."""
    for place, target, size, watt, colour in (
        ((3.3, 1.6, 2.0), (0, 0, 0.9), 1.6, 170, (1.0, 0.97, 0.92)),
        ((0, 1.0, 3.2), (0, 0, 0), 2.0, 90, (1.0, 0.93, 0.82)),
    ):
        lamp = bpy.data.lights.new('lamp', 'AREA')
        lamp.energy, lamp.size, lamp.color = watt, size, colour
        thing = bpy.data.objects.new('lamp', lamp)
        thing.location = place
        towards = mathutils.Vector(target) - mathutils.Vector(place)
        thing.rotation_euler = towards.to_track_quat('-Z', 'Y').to_euler()
        bpy.context.scene.collection.objects.link(thing)
    world = bpy.data.worlds.new('world')
    world.use_nodes = True
    sky = world.node_tree.nodes['Background']
    sky.inputs['Color'].default_value, sky.inputs['Strength'].default_value = (
        (0.75, 0.82, 1, 1),
        0.35,
    )
    bpy.context.scene.world = world


def dress(avatar: Avatar) -> list:
    """Parts of the person: object, indices (n,) of its vertices, and their shifts (n,), m."""
    rest, heads, parts = avatar.rest, avatar.heads, []
    skin_faces = avatar.part('body')
    up, everywhere = rest[:, 2], np.zeros(len(rest))
    torso = avatar.weight(
        'Hips', 'LHipJoint', 'RHipJoint', 'LowerBack', 'Spine', 'Spine1', 'LeftShoulder',
        'RightShoulder',
    )  # fmt: skip
    limbs = [side + part for side in ('Left', 'Right') for part in ('Arm', 'ForeArm', 'Hand')]
    arms = avatar.weight(*limbs)
    legs = avatar.weight('LeftUpLeg', 'RightUpLeg', 'LeftLeg', 'RightLeg')
    feet = avatar.weight('LeftFoot', 'RightFoot', 'LeftToeBase', 'RightToeBase')
    waist, ankle = heads['LowerBack'][2] - 0.055, heads['LeftFoot'][2]
    sleeves = np.zeros(len(rest), dtype=bool)
    for bone in ('LeftArm', 'RightArm'):
        own, axis = avatar.weight(bone), avatar.tails[bone] - heads[bone]
        along = (rest - heads[bone]) @ axis / (axis @ axis)
        sleeves |= (own + torso > 0.6) & (own > 0.02) & (along < 0.72)
    collar = np.linalg.norm((rest - heads['Neck'])[:, :2] / [1, 1.2], axis=1) < 0.075
    shirt = ((torso > 0.5) & (up > waist - 0.06)) | sleeves
    shirt &= ~(collar & (up > heads['LeftShoulder'][2]))
    lower = avatar.weight('LeftLeg', 'RightLeg') > 0.5
    trousers = (torso + legs > 0.6) & (up < waist + 0.02) & (arms < 0.1) & (feet < 0.6)
    trousers &= ~(lower & (up < ankle + 0.045)) & (up > ankle + 0.03)
    shoes = up < ankle + 0.02
    eye = np.mean([rest[i] for face in avatar.part('helper-l-eye') for i in face], axis=0)
    eyes = (eye, eye * [-1, 1, 1])
    head = avatar.weight('Head', 'Neck1') > 0.5
    # The hair line runs from above the brows over the ears to the neck.
    back = rest[:, 1] - eye[1]
    line = np.interp(back, [-0.03, 0.045, 0.09, 0.13, 0.25], [0.075, 0.03, 0.0, -0.05, -0.075])
    hair = head & (up > eye[2] + line)
    waves = np.sin(28 * up) * np.sin(33 * rest[:, 0]) + 0.5 * np.sin(60 * up + 20 * rest[:, 1])
    folds = np.interp(waves, [-1.5, 1.5], [-1.0, 1.0])

    def add(name, faces, push, look, colours=None, *, smooth=True) -> None:
        which = np.unique(np.concatenate([np.array(face) for face in faces]))
        mesh = bpy.data.meshes.new(name)
        at = {int(vertex): k for k, vertex in enumerate(which)}
        mesh.from_pydata(rest[which].tolist(), [], [[at[i] for i in face] for face in faces])
        mesh.materials.append(look)
        for polygon in mesh.polygons:
            polygon.use_smooth = True
        if colours is not None:
            layer = mesh.color_attributes.new('colour', 'FLOAT_COLOR', 'POINT')
            layer.data.foreach_set('color', np.insert(colours[which], 3, 1.0, axis=1).ravel())
        thing = bpy.data.objects.new(name, mesh)
        bpy.context.scene.collection.objects.link(thing)
        if smooth:
            modifier = thing.modifiers.new('smooth', 'SUBSURF')
            modifier.levels = modifier.render_levels = 1
        parts.append((thing, which, push[which]))

    def covered(*masks) -> list:
        return [face for face in skin_faces if all(any(m[i] for m in masks) for i in face)]

    hidden = {tuple(face) for face in covered(shirt, trousers, shoes)}
    bare = [face for face in skin_faces if tuple(face) not in hidden]
    skin = material('skin', (0.5, 0.27, 0.19), 0.5, 0.12, 40, painted=True, skin=True)
    add('skin', bare, everywhere, skin, _face(avatar, eyes, head))
    wide = np.clip((heads['Spine1'][2] - up) / 0.3, 0, 1)
    cloth = material('shirt', (0.06, 0.19, 0.36), 0.9, 0.25, 30)
    add('shirt', covered(shirt), 0.016 + 0.012 * wide + 0.005 * folds, cloth)
    wide = np.clip((heads['LeftLeg'][2] + 0.1 - up) / 0.4, 0, 1)
    cloth = material('trousers', (0.09, 0.085, 0.075), 0.95, 0.3, 50)
    add('trousers', covered(trousers), 0.014 + 0.012 * wide + 0.005 * folds, cloth)
    leather = material('shoes', (0.4, 0.4, 0.4), 0.6, 0.4)
    add('shoes', covered(shoes), everywhere + 0.011, leather)
    fur = material('hair', (0.045, 0.025, 0.012), 0.6, 0.7, 120)
    add('hair', covered(hair), 0.014 + 0.003 * folds, fur)
    for group, centre in zip(('helper-l-eye', 'helper-r-eye'), eyes):
        colours = np.tile([0.75, 0.72, 0.70], (len(rest), 1))
        near = np.linalg.norm((rest - centre)[:, [0, 2]], axis=1) < 0.0072
        colours[near & (rest[:, 1] < centre[1])] = 0.10, 0.06, 0.04
        ball = material(group, (1, 1, 1), 0.15, painted=True)
        add(group, avatar.part(group), everywhere, ball, colours, smooth=False)
    lashes = [
        x for side in 'lr' for k in (1, 2) for x in avatar.part(f'helper-{side}-eyelashes-{k}')
    ]
    add('lashes', lashes, everywhere, material('lash', (0.02, 0.015, 0.01), 0.8), smooth=False)
    return parts


def _face(avatar: Avatar, eyes, head) -> np.ndarray:
    """Colours (V, 3) of the skin, with lips, brows and cheeks."""
    rest = avatar.rest
    colours = np.tile([0.50, 0.27, 0.19], (len(rest), 1))
    front = rest[head & (np.abs(rest[:, 0]) < 0.01)][:, 1].min()
    spots = [([0, front + 0.012, avatar.mouth[2]], [0.026, 0.03, 0.009], [0.38, 0.11, 0.10], 1.0)]
    for eye in eyes:
        side = np.sign(eye[0])
        brow = np.add(eye, [0.003 * side, -0.012, 0.024])
        cheek = np.add(eye, [0.03 * side, -0.01, -0.035])
        spots.append((brow, [0.022, 0.03, 0.006], [0.05, 0.03, 0.02], 1.0))
        spots.append((cheek, [0.025, 0.03, 0.02], [0.55, 0.24, 0.18], 0.4))
    for centre, radii, colour, most in spots:
        far = np.linalg.norm((rest - centre) / radii, axis=1)
        share = (most * np.clip(1.4 - far, 0, 1) * head)[:, None]
        colours = colours * (1 - share) + np.array(colour) * share
    return colours


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
