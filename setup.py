from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).resolve().parent
PACKAGE = 'hmt_ros'


def files(folder: str, pattern: str) -> list[str]:
    """Files of a folder as setuptools wants them: relative to this file, in a fixed order."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).glob(pattern))


setup(
    name=PACKAGE,
    version='0.1.0',
    description='Monocular 3D human motion tracking with mixtures, for ROS 2',
    license='Apache-2.0',
    maintainer='hmt_ros maintainers',
    maintainer_email='hmt-ros@example.com',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*', 'msg_tools', 'msg_tools.*']),
    package_data={
        PACKAGE: [
            'config/*.yaml',
            'config/*.xml',
            'body/models/*.yaml',
            'body/models/*.npz',
            'experts/models/*.npz',
            'image/*.yaml',
            'app/report/page/*',
        ],
        # The message definitions are read by whoever works on bags without ROS.
        'msg_tools': ['hmt_msgs/msg/*.msg', 'hmt_msgs/srv/*.srv'],
    },
    data_files=[
        (target, sources)
        for target, sources in (
            ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
            (f'share/{PACKAGE}', ['package.xml']),
            (f'share/{PACKAGE}/config', files(f'{PACKAGE}/config', '*.*ml')),
            (f'share/{PACKAGE}/launch', files('launch', '*.launch.*')),
            (f'share/{PACKAGE}/rviz', files('rviz', '*.rviz')),
            (f'share/{PACKAGE}/foxglove', files('foxglove', '*.json')),
            (f'share/{PACKAGE}/security', files('security', '*.xml')),
        )
        if sources
    ],
    python_requires='>=3.10',
    install_requires=[
        'setuptools',
        'numpy',
        'scipy',
        'numba',
        'PyYAML',
        'matplotlib',
        'mcap',
        'rosbags',
        'tqdm',
        'lz4',
        'zstandard',
    ],
    # OpenCV has several distributions of one module (apt, opencv-python, -headless): naming one
    # here would install it a second time next to another.
    extras_require={
        'test': ['pytest', 'hypothesis'],
        'dask': ['distributed'],
        'mediapipe': ['mediapipe==0.10.21'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'filter_node = hmt_ros.nodes.filter_node:main',
            'smoother_node = hmt_ros.nodes.smoother_node:main',
            'bme_node = hmt_ros.nodes.bme_node:main',
            'people_node = hmt_ros.nodes.people_node:main',
            'track-video = hmt_ros.app.track_video:main',
            'import-video = hmt_ros.app.import_video.command:main',
            'subject = hmt_ros.app.subject:main',
            'keypoints_node = hmt_ros.nodes.keypoints_node:main',
            'keypoints_adapter_node = hmt_ros.nodes.keypoints_adapter_node:main',
            'replay = hmt_ros.app.replay.command:main',
            'recover = hmt_ros.app.recover:main',
            'make-bag = hmt_ros.app.make_bag:main',
            'train = hmt_ros.app.train:main',
            'learn-prior = hmt_ros.app.learn_prior:main',
            'learn-motion = hmt_ros.app.learn_motion:main',
            'learn-lengths = hmt_ros.app.learn_lengths:main',
            'report = hmt_ros.app.report.command:main',
            'evaluate = hmt_ros.app.evaluate:main',
        ],
    },
)
