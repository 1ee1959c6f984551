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
"""The parameters, typed and validated, for the node, replay and the library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
from dataclasses import dataclass
import difflib
import math
from numbers import Real
import os
import re
import reprlib
from typing import Any, NamedTuple

NODE_NAME = 'ins_align'
STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901
MAX_PARAMS_BYTES = 1 << 20

AUTO_OR_BOOL = ('auto', True, False)
# rclpy declares these on every node, so a parameter file may hold them.
RCLPY_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


class UsageError(ValueError):
    """A mistake of the user; the text is one sentence that says what is wrong."""


class ConfigError(UsageError):
    """A wrong parameter; the text says which one, why, and what would be right."""


class ImuNoise(NamedTuple):
    """Noise of an IMU in SI units, 1 sigma per axis."""

    angle_random_walk: float  # rad/sqrt(s)
    velocity_random_walk: float  # m/s/sqrt(s)
    gyro_bias_std: float  # rad/s
    accel_bias_std: float  # m/s^2
    gyro_scale_std: float = 0.0  # scale factor error of the gyros, 0.01 is one percent
    rate_random_walk: float = 0.0  # of the gyro biases, rad/s/sqrt(s)


def _imu_noise(arw: float, vrw: float, gyro_bias: float, accel_bias: float,
               gyro_scale: float = 0.0, rate_walk: float = 0.0) -> ImuNoise:
    """Convert from deg/sqrt(h), m/s/sqrt(h), deg/s, m/s^2, 1 and deg/s/sqrt(h) to SI units."""
    return ImuNoise(math.radians(arw) / 60.0, vrw / 60.0, math.radians(gyro_bias), accel_bias,
                    gyro_scale, math.radians(rate_walk) / 60.0)


PRESETS = {
    'navigation': _imu_noise(0.002, 0.003, 0.01 / 3600.0, 50e-6 * STANDARD_GRAVITY),
    'tactical': _imu_noise(0.05, 0.03, 1.0 / 3600.0, 1e-3 * STANDARD_GRAVITY, 0.0005,
                           1.8 / 3600.0),
    'mems': _imu_noise(0.3, 0.09, 0.1, 0.05, 0.01, 0.15),
    # Bare chips of autopilots and phones, from data sheets. MPU-6000 (PS-MPU-6000A-00): zero-g
    # 50 to 80 mg, 400 ug/sqrt(Hz), scale 3 %, gyros 0.005 deg/s/sqrt(Hz). BMI055: zero-g 70 mg,
    # zero-rate 1 deg/s, 0.014 deg/s/sqrt(Hz). Soldering and temperature add errors.
    'chip': _imu_noise(0.9, 0.27, 1.0, 0.5, 0.03, 0.45),
}
# Sigmas that a chip reaches within one or two minutes with turns, deg.
CHIP_THRESHOLDS = {'tilt_std_threshold': 1.0, 'heading_std_threshold': 2.0}


def _parameter(default: Any, description: str, unit: str = '', minimum: float | None = None,
               maximum: float | None = None, *, choices: tuple[Any, ...] = (),
               runtime: bool = False) -> Any:
    return dataclasses.field(default=default, metadata={
        'description': description, 'unit': unit, 'minimum': minimum, 'maximum': maximum,
        'choices': choices, 'read_only': not runtime})


@dataclass(frozen=True)
class Config:
    """
    All parameters, checked.

    Each field's metadata holds ``description``, ``unit``, ``minimum`` and ``maximum`` (inclusive;
    None if it is not a number), ``choices`` and ``read_only``. A ConfigError is raised if a value
    is of the wrong type, out of range or in contradiction to another one.
    """

    lever_arm: tuple[float, float, float] = _parameter(
        (0.0, 0.0, 0.0), 'vector from the IMU to the GNSS antenna, in the axes of the IMU (x '
        'forward, y left, z up); each number with a decimal point: 0.0', 'm', -1000.0, 1000.0)
    lever_arm_std: float = _parameter(
        1.0, 'uncertainty of the lever arm, 1 sigma per axis; above 0 the lever arm is estimated',
        'm', 0.0, 100.0)
    lever_arm_from_tf: str | bool = _parameter(
        'auto', 'take the lever arm from the transform between the frame_ids of IMU and position '
        'messages (/tf_static); auto: if there is one and lever_arm is not set or zero; true: '
        'always, and wait for it', choices=AUTO_OR_BOOL)
    base_frame: str = _parameter(
        '', 'frame whose attitude status, JSON and ~/base_imu give as well, from TF; empty: none')
    vehicle: str = _parameter(
        'none', 'type of vehicle: base_frame (the IMU if that is empty) has x forward and z up, '
        'and its origin, for a car at the rear axle, moves along x. This gives a heading on a '
        'straight road; a car that is faster than a few m/s is taken to go forwards. If the '
        'motion contradicts this, it is not used, and the reason says so',
        choices=('none', 'car', 'boat', 'aeroplane'))
    vehicle_velocity_std: float = _parameter(
        0.0, 'lasting velocity sideways and upwards (slip, leeway, wind), 1 sigma; 0: 0.1 for a '
        'car, 1 for a boat, 10 for an aeroplane', 'm/s', 0.0, 100.0)
    mount_yaw_std: float = _parameter(
        1.0, 'angle between the x axis and the direction of motion, sideways and upwards, 1 '
        'sigma; a heading from vehicle is no better than this', 'deg', 0.0, 30.0)
    use_velocity: str | bool = _parameter(
        'auto', 'align with GNSS velocities; auto: if they arrive', choices=AUTO_OR_BOOL)
    use_position: str | bool = _parameter(
        'auto', 'align with GNSS positions; auto: if no velocity arrives', choices=AUTO_OR_BOOL)
    fix_type: str = _parameter(
        'NavSatFix', 'message type of the position topic; GPSFix of gps_msgs and NavPVT of '
        'ublox_msgs include the velocity, and no velocity topic is read',
        choices=('NavSatFix', 'GPSFix', 'NavPVT'))
    velocity_type: str = _parameter(
        'TwistWithCovarianceStamped', 'message type of the velocity topic',
        choices=('TwistWithCovarianceStamped', 'TwistStamped', 'Odometry', 'Vector3Stamped'))
    velocity_frame: str = _parameter(
        'auto', 'world frame of the antenna velocity: east-north-up or north-east-down, whatever '
        'the frame_id is; auto: enu, but a velocity with the frame_id of a body is refused',
        choices=('auto', 'enu', 'ned'))
    velocity_vertical: str = _parameter(
        'measured', 'absent: the receiver does not measure the vertical velocity and sends 0, as '
        'NMEA drivers do', choices=('measured', 'absent'))
    gnss_delay: float = _parameter(
        0.0, 'how much older than its stamp a GNSS measurement is', 's', -60.0, 60.0)
    gnss_delay_std: float = _parameter(
        0.1, 'uncertainty of the delay, 1 sigma; above 0 the delay is estimated', 's', 0.0, 10.0)
    gnss_lateness: float = _parameter(
        1.0, 'how much later than newer IMU samples a GNSS or IMU message may arrive and still be '
        'used', 's', 0.0, 60.0)
    imu_grade: str = _parameter(
        'mems', 'preset of the six parameters below, of which those above 0 replace the figure of '
        'the preset; custom: the first four must be set', choices=(*PRESETS, 'custom'))
    angle_random_walk: float = _parameter(
        0.0, "angle random walk of the gyroscopes; 0: the preset's", 'deg/sqrt(h)', 0.0, 1000.0)
    velocity_random_walk: float = _parameter(
        0.0, "velocity random walk of the accelerometers; 0: the preset's", 'm/s/sqrt(h)', 0.0,
        1000.0)
    gyro_bias_std: float = _parameter(
        0.0, "gyroscope bias, 1 sigma per axis; 0: the preset's", 'deg/s', 0.0, 100.0)
    accel_bias_std: float = _parameter(
        0.0, "accelerometer bias, 1 sigma per axis; 0: the preset's", 'm/s^2', 0.0, 10.0)
    gyro_scale_std: float = _parameter(
        0.0, 'scale factor error of the gyroscopes, 1 sigma per axis, 0.01 is one percent; 0: the '
        "preset's. If it is above 0, scale factors, misalignment (3 tenths of it) and the same "
        'errors of the accelerometers (3 tenths of it) are estimated', '1', 0.0, 0.5)
    rate_random_walk: float = _parameter(
        0.0, 'rate random walk of the gyroscopes, the random walk of their biases; 0: the '
        "preset's", 'deg/s/sqrt(h)', 0.0, 100.0)
    velocity_std: float = _parameter(
        0.3, 'horizontal GNSS velocity, 1 sigma per axis, if the messages state none; the noise '
        'is then estimated from this value on', 'm/s', 1e-4, 100.0)
    velocity_std_vertical: float = _parameter(
        0.6, 'vertical GNSS velocity, 1 sigma, if the messages state none', 'm/s', 1e-4, 100.0)
    position_std: float = _parameter(
        2.5, 'horizontal GNSS position, 1 sigma per axis, if the messages state none; the noise '
        'is then estimated from this value on', 'm', 1e-4, 1000.0)
    position_std_vertical: float = _parameter(
        5.0, 'vertical GNSS position, 1 sigma, if the messages state none', 'm', 1e-4, 1000.0)
    heading_std_threshold: float = _parameter(
        1.0, 'the heading is declared if its sigma is below this', 'deg', 1e-4, 180.0,
        runtime=True)
    tilt_std_threshold: float = _parameter(
        0.5, 'roll and pitch are declared if their sigmas are below this', 'deg', 1e-4, 90.0,
        runtime=True)
    hold_time: float = _parameter(
        1.0, 'how long all conditions must hold before a declaration', 's', 0.0, 3600.0,
        runtime=True)
    trust_imu_axes: bool = _parameter(
        False, 'axes and signs of the IMU are certainly right: declare a heading without motion '
        'that confirms them, also at rest', choices=(True, False))
    method: str = _parameter(
        'bank', 'bank: bank of Kalman filters, which estimate the errors of the IMU; vif, pif: '
        'velocity and position integration formula as published, whose sigmas do not include '
        'these errors', choices=('vif', 'pif', 'bank'))
    free_start: bool = _parameter(
        True, 'vif and pif: do not use the noisy first velocity and rate in every later vector; '
        'false: the published formula', choices=(True, False))
    world_frame_id: str = _parameter(
        'map', 'frame_id of published attitudes: the ENU frame')

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = checked(field, getattr(self, field.name))
            object.__setattr__(self, field.name, value)
        if self.use_velocity is False and self.use_position is False:
            raise ConfigError('use_velocity and use_position are both false: nothing is left to '
                              'align with, set one of them to auto or true')
        if self.method == 'vif' and self.use_velocity is False:
            raise ConfigError('method vif needs velocities, but use_velocity is false: set it to '
                              'auto or true, or use the method pif or bank')
        if self.use_position is True and (self.method == 'vif' or (
                self.method == 'pif' and self.use_velocity is not False)):
            raise ConfigError(
                f'method {self.method} does not align with positions beside velocities, but '
                'use_position is true: set it to auto, '
                + ('' if self.method == 'vif' else 'or use_velocity to false, ')
                + 'or use the method bank')
        if self.vehicle != 'none' and self.method != 'bank':
            raise ConfigError(f'method {self.method} uses nothing of what a vehicle knows, but '
                              f'vehicle is {self.vehicle}: set it to none, or use the method '
                              'bank')
        if self.imu_grade == 'custom':
            missing = [name for name in ImuNoise._fields[:4] if getattr(self, name) == 0.0]
            if missing:
                raise ConfigError('imu_grade custom needs all four figures of the IMU above 0, '
                                  f'missing: {", ".join(missing)}')

    @property
    def imu_noise(self) -> ImuNoise:
        """Noise of the IMU in SI units: the figures above 0, and the preset for the others."""
        own = _imu_noise(*(getattr(self, name) for name in ImuNoise._fields))
        preset = PRESETS.get(self.imu_grade, own)
        return ImuNoise(*(given or usual for given, usual in zip(own, preset)))


def config_from_mapping(values: Mapping[str, Any]) -> Config:
    """Return the configuration with these values by name; a ConfigError says what is wrong."""
    known, unknown = without_unknown(values)
    if unknown:
        raise ConfigError(unknown[0])
    return Config(**known)


def without_unknown(values: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """
    Return the values of known parameters, and a warning for each unknown name.

    An unknown name may be misspelt, or a parameter of another node in the same file.
    """
    known = [field.name for field in dataclasses.fields(Config)]
    sentences = []
    for name in sorted(str(name) for name in values if name not in known):
        if name.split('.')[0] not in RCLPY_PARAMETERS:
            close = difflib.get_close_matches(name, known)
            hint = f': did you mean {" or ".join(close)}?' if close else ''
            sentences.append(f'parameter {reprlib.repr(name)} is not known{hint}')
    return {name: value for name, value in values.items() if name in known}, sentences


def load_params(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Read a ROS 2 parameter file; return the unchecked values of this node by name.

    A ConfigError is raised if the file cannot be read, or holds ``ros__parameters`` for no node of
    this name or wildcard (``/**``), or for two nodes of this name.
    """
    try:
        with open(path, 'rb') as file:
            text = file.read(MAX_PARAMS_BYTES + 1)
    except OSError as error:
        raise ConfigError(f'cannot read the parameter file {path}: {error.strerror}') from None
    if len(text) > MAX_PARAMS_BYTES:
        raise ConfigError(f'{path} is larger than {MAX_PARAMS_BYTES >> 20} MiB: '
                          'that is no parameter file')
    values: dict[str, Any] = {}
    found = [section for section in _node_sections(_parse_yaml(text, str(path)), '')
             if section[0].rsplit('/', 1)[-1] in (NODE_NAME, '*', '**')]
    nodes = [node for node, _ in found if node.endswith(f'/{NODE_NAME}')]
    if len(nodes) > 1:
        raise ConfigError(f'{path} holds parameters for {" and ".join(nodes)}: leave only those '
                          'of one of them')
    if not found:
        raise ConfigError(f'{path} holds no parameters for this node: expected '
                          f'"{NODE_NAME}:" or "/**:" with "ros__parameters:" below')
    for node, content in found:
        if not isinstance(content, dict):
            raise ConfigError(f'{path}: ros__parameters of {node} must be a mapping of names '
                              'to values')
        values.update(content)
    return values


def parse_override(text: str) -> tuple[str, Any]:
    """Return name and value of ``name=value``, the value in YAML; may raise ConfigError."""
    name, equals, value = text.partition('=')
    if not equals or not name.strip():
        raise ConfigError(f'expected NAME=VALUE, got {reprlib.repr(text)}')
    name = name.strip()
    return name, _parse_yaml(value, f'the value of {name}')


def _parse_yaml(text: str | bytes, source: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Loads YAML as ROS does: 1e-3 is a number, aliases are refused."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
                raise yaml.composer.ComposerError(None, None, 'aliases are not allowed', mark)
            return super().compose_node(parent, index)

    Loader.add_implicit_resolver(
        'tag:yaml.org,2002:float', re.compile(r'^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
        list('-+.0123456789'))
    try:
        return yaml.load(text, Loader=Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        where = f', line {mark.line + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or 'not text'
        raise ConfigError(f'{source} is not valid YAML{where}: {problem}') from None
    except (RecursionError, ValueError, TypeError, OverflowError):
        raise ConfigError(f'{source} is not valid YAML') from None


def _node_sections(tree: Any, prefix: str, depth: int = 8) -> Iterable[tuple[str, Any]]:
    """Yield the full node name and the content of each ``ros__parameters`` section."""
    if not isinstance(tree, dict) or depth == 0:
        return
    for key, content in tree.items():
        if key == 'ros__parameters':
            yield prefix or '/', content
        else:
            yield from _node_sections(content, f'{prefix}/{str(key).strip("/")}', depth - 1)


def checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """
    Return a value, checked and converted to the type of the field's default.

    A field takes one of its ``choices``, a name, a number, or as many numbers as its default or
    its ``names`` has. A ConfigError says what is expected.
    """
    metadata, default = field.metadata, field.default
    if choices := metadata['choices']:
        # Where only a string fits, a boolean arrives as "true".
        if isinstance(value, str) and value.lower() in ('true', 'false') and True in choices:
            value = value.lower() == 'true'
        # The type is compared too, because 1 == True.
        fits = any(type(value) is type(choice) and value == choice for choice in choices)
        expected = f'one of {listed_choices(choices)}'
    elif isinstance(default, str):
        expected = 'a name without spaces and without a leading slash'
        fits = value == default == '' or isinstance(value, str) and bool(
            re.fullmatch(r'[^\s/][^\s]{0,255}', value))
    else:
        count = len(default if isinstance(default, tuple) else metadata.get('names', ()))
        expected = (f'{count} finite numbers' if count else 'a finite number') + _range(metadata)
        try:
            numbers = list(value) if count and not isinstance(value, (str, Mapping)) else [value]
            fits = len(numbers) == (count or 1) and all(
                isinstance(number, Real) and not isinstance(number, bool)
                and math.isfinite(number) and metadata['minimum'] <= number <= metadata['maximum']
                for number in numbers)
        except (TypeError, OverflowError):  # not a list; an integer too large for a float
            fits = False
        if fits:
            value = tuple(map(float, value)) if count else float(value)
    if not fits:
        got = ' '.join(reprlib.repr(value).split())
        raise ConfigError(f'{field.name} must be {expected}, got {got}')
    return value


def listed_choices(choices: Iterable[Any]) -> str:
    """List the choices of a parameter as they are written in YAML."""
    return ', '.join(str(choice).lower() if isinstance(choice, bool) else str(choice) or '""'
                     for choice in choices)


def _range(metadata: Mapping[str, Any]) -> str:
    """Return the unit and the limits of a number in words."""
    unit = '' if metadata['unit'] in ('', '1') else f' in {metadata["unit"]}'
    if metadata['maximum'] < math.inf:
        return f'{unit} from {metadata["minimum"]:g} to {metadata["maximum"]:g}'
    if metadata['minimum'] > -math.inf:
        return f'{unit}, {metadata["minimum"]:g} or above'
    return unit
