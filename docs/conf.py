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
"""Sphinx configuration; `make docs` builds it, rosdoc2 finds it."""

project = 'ins_align'
author = 'The ins_align Authors'
copyright = '2026, The ins_align Authors'  # noqa: A001 (the name that Sphinx wants)
release = version = '0.1.0'

extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.mathjax',
    'sphinx.ext.napoleon',
    'sphinx.ext.viewcode',
]
myst_enable_extensions = ['amsmath', 'colon_fence', 'dollarmath']
myst_heading_anchors = 3

html_theme = 'sphinx_rtd_theme'

# Documentation is built where there may be no ROS.
autodoc_mock_imports = [
    'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces', 'rclpy', 'sensor_msgs',
    'std_srvs',
]
autodoc_default_options = {'members': True, 'member-order': 'bysource', 'show-inheritance': True}
autodoc_typehints = 'signature'
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
# Single backquotes name something of this package.
default_role = 'literal'
