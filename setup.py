# Copyright 2026 The ins_align Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

from glob import glob

from setuptools import find_packages, setup

package_name = 'ins_align'

# The robot needs numpy and PyYAML (parameter files of replay); ROS brings rclpy and messages.
replay = ['rosbags>=0.11', 'backports.zstd; python_version < "3.14"', 'lz4', 'tqdm']
simulation = ['python-ins>=1.0', 'rosbags>=0.11', 'scipy>=1.11']
extras = {
    'replay': replay,
    'dask': ['distributed>=2024.1'],
    'plot': ['matplotlib>=3.8'],
    'simulation': simulation,
    'experiments': [*replay, *simulation, 'matplotlib>=3.8'],
    'test': [
        'catkin-pkg', 'hypothesis', 'mcap', 'mypy', 'pytest', 'pytest-cov', 'pytest-xdist',
        'ros-ament-flake8', 'ros-ament-pep257', 'flake8', 'flake8-blind-except', 'flake8-builtins',
        'flake8-class-newline', 'flake8-comprehensions', 'flake8-deprecated', 'flake8-docstrings',
        'flake8-import-order', 'flake8-quotes', 'pydocstyle', 'types-PyYAML',
    ],
    'docs': ['myst-parser', 'sphinx', 'sphinx-rtd-theme'],
}
extras['all'] = sorted({requirement for extra in extras.values() for requirement in extra})

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(include=[package_name, package_name + '.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.yaml')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.*')),
    ],
    python_requires='>=3.10',
    install_requires=['setuptools', 'numpy>=1.26', 'pyyaml'],
    extras_require=extras,
    zip_safe=True,
    author='The ins_align Authors',
    maintainer='The ins_align Authors',
    maintainer_email='ins-align@example.org',
    keywords=['ROS', 'INS', 'GNSS', 'IMU', 'alignment', 'heading'],
    classifiers=[
        'Intended Audience :: Science/Research',
        'Programming Language :: Python :: 3',
        'Topic :: Scientific/Engineering',
    ],
    description='Roll, pitch and true heading from an IMU and a GNSS receiver while moving.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'ins_align = ins_align.cli:main',
            'ins_align_node = ins_align.ros.main:main',
        ],
    },
)
