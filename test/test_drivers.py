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
"""Messages of receivers and autopilots, in recordings made with their public definitions."""

from dataclasses import replace
from datetime import datetime, timezone
import math
from types import SimpleNamespace

from ins_align.config import Config
from ins_align.gnss.drivers import NoTimeError, receiver_from_msg, RECEIVERS
from ins_align.gnss.messages import MessageError
from ins_align.offline import replay
from ins_align.recordings import BagError
from ins_align.recordings.info import inspect
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from recordings import make_header, make_imu, typestore
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

FIX_TYPE, NAVPVT = 'gps_msgs/msg/GPSFix', 'ublox_msgs/msg/NavPVT'
GEODETIC, SENSOR_GPS = 'septentrio_gnss_driver/msg/PVTGeodetic', 'px4_msgs/msg/SensorGps'
COMBINED, IMU = 'px4_msgs/msg/SensorCombined', 'sensor_msgs/msg/Imu'
# Fields of the public definitions: gps_umd, ublox and septentrio_gnss_driver (ROS 2), px4_msgs.
DEFINITIONS = {
    FIX_TYPE: 'std_msgs/Header header;GPSStatus status;' + ''.join(
        f'float64 {name};' for name in (
            'latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop '
            'vdop tdop err err_horz err_vert err_track err_speed err_climb err_time err_pitch '
            'err_roll err_dip').split())
    + 'float64[9] position_covariance;uint8 position_covariance_type;'
    + 80 * '=' + ';MSG: gps_msgs/GPSStatus;std_msgs/Header header;uint16 satellites_used;'
    'int32[] satellite_used_prn;uint16 satellites_visible;int32[] satellite_visible_prn;'
    'int32[] satellite_visible_z;int32[] satellite_visible_azimuth;int32[] satellite_visible_snr;'
    'int16 status;uint16 motion_source;uint16 orientation_source;uint16 position_source',
    NAVPVT: 'uint8 CLASS_ID = 1;uint32 i_tow;uint16 year;uint8 month;uint8 day;uint8 hour;'
    'uint8 min;uint8 sec;uint8 valid;uint32 t_acc;int32 nano;uint8 fix_type;uint8 flags;'
    'uint8 flags2;uint8 num_sv;int32 lon;int32 lat;int32 height;int32 h_msl;uint32 h_acc;'
    'uint32 v_acc;int32 vel_n;int32 vel_e;int32 vel_d;int32 g_speed;int32 heading;uint32 s_acc;'
    'uint32 head_acc;uint16 p_dop;uint8[6] reserved1;int32 head_veh;int16 mag_dec;uint16 mag_acc',
    GEODETIC: 'std_msgs/Header header;BlockHeader block_header;uint8 mode;uint8 error;'
    'float64 latitude;float64 longitude;float64 height;float32 undulation;float32 vn;float32 ve;'
    'float32 vu;float32 cog;float64 rx_clk_bias;float32 rx_clk_drift;uint8 time_system;'
    'uint8 datum;uint8 nr_sv;uint8 wa_corr_info;uint16 reference_id;uint16 mean_corr_age;'
    'uint32 signal_info;'
    'uint8 alert_flag;uint8 nr_bases;uint16 ppp_info;uint16 latency;uint16 h_accuracy;'
    'uint16 v_accuracy;uint8 misc;' + 80 * '=' + ';MSG: septentrio_gnss_driver/BlockHeader;'
    'uint8 sync_1;uint8 sync_2;uint16 crc;uint16 id;uint8 revision;uint16 length;uint32 tow;'
    'uint16 wnc',
    SENSOR_GPS: 'uint64 timestamp;uint64 timestamp_sample;uint32 device_id;float64 latitude_deg;'
    'float64 longitude_deg;float64 altitude_msl_m;float64 altitude_ellipsoid_m;'
    'float32 s_variance_m_s;float32 c_variance_rad;uint8 fix_type;float32 eph;float32 epv;'
    'float32 hdop;float32 vdop;int32 noise_per_ms;uint16 automatic_gain_control;'
    'uint8 jamming_state;int32 jamming_indicator;uint8 spoofing_state;float32 vel_m_s;'
    'float32 vel_n_m_s;float32 vel_e_m_s;float32 vel_d_m_s;float32 cog_rad;bool vel_ned_valid;'
    'int32 timestamp_time_relative;uint64 time_utc_usec;uint8 satellites_used;float32 heading;'
    'float32 heading_offset;float32 heading_accuracy',
    COMBINED: 'uint64 timestamp;int32 RELATIVE_TIMESTAMP_INVALID = 2147483647;float32[3] gyro_rad;'
    'uint32 gyro_integral_dt;int32 accelerometer_timestamp_relative;float32[3] accelerometer_m_s2;'
    'uint32 accelerometer_integral_dt;uint8 accelerometer_clipping;uint8 gyro_clipping;'
    'uint8 accel_calibration_count;uint8 gyro_calibration_count',
}
SIGMA = np.array([2.5, 5.0, 0.1])  # of the simulation: position, altitude, velocity


def fields_of(msgtype, stamp_ns, position, velocity):
    """Return what a driver would put into a message; position in degrees, velocity in ENU."""
    east, north, up = velocity
    latitude, longitude, altitude = position
    time = datetime.fromtimestamp(stamp_ns // 10 ** 9, timezone.utc)
    status = {'status': {'status': 0}}
    return {
        FIX_TYPE: {
            **status, 'latitude': latitude, 'longitude': longitude, 'altitude': altitude,
            'speed': math.hypot(east, north), 'climb': up,
            'track': math.degrees(math.atan2(east, north)) % 360.0,
            'position_covariance': np.diag(SIGMA[[0, 0, 1]] ** 2).ravel(),
            'position_covariance_type': 2, 'err_speed': 2 * SIGMA[2], 'err_climb': 2 * SIGMA[2]},
        NAVPVT: {
            **{name: getattr(time, name) for name in ('year', 'month', 'day', 'hour')},
            'min': time.minute, 'sec': time.second, 'nano': stamp_ns % 10 ** 9, 'valid': 7,
            'fix_type': 3, 'flags': 1, 'lat': round(latitude * 1e7), 'lon': round(longitude * 1e7),
            'height': round(altitude * 1e3), 'h_acc': 2500, 'v_acc': 5000, 's_acc': 100,
            'vel_n': round(north * 1e3), 'vel_e': round(east * 1e3), 'vel_d': round(-up * 1e3)},
        GEODETIC: {
            'mode': 1, 'latitude': math.radians(latitude), 'longitude': math.radians(longitude),
            'height': altitude, 've': east, 'vn': north, 'vu': up, 'h_accuracy': 707,
            'v_accuracy': 1000},
        SENSOR_GPS: {
            'timestamp': stamp_ns // 1000, 'fix_type': 3, 'latitude_deg': latitude,
            'longitude_deg': longitude, 'altitude_ellipsoid_m': altitude, 'eph': 2.5, 'epv': 5.0,
            's_variance_m_s': 0.1, 'vel_n_m_s': north, 'vel_e_m_s': east, 'vel_d_m_s': -up,
            'vel_ned_valid': True}}[msgtype]


def make(store, msgtype, stamp_ns, **given):
    """Make a message whose other fields are 0."""
    values = {}
    for name, (kind, detail) in store.fielddefs[msgtype][1]:
        if name == 'header':
            values[name] = make_header(store, stamp_ns, 'gnss')
        elif kind.name == 'NAME':
            values[name] = make(store, detail, stamp_ns, **given.get(name, {}))
        elif kind.name == 'BASE':
            values[name] = given.get(name, 0)
        else:
            count = detail[1] if kind.name == 'ARRAY' else 0
            values[name] = np.array(given.get(name, np.zeros(count)), detail[0][1][0])
    return store.types[msgtype](**values)


def write(path, simulation, gnss_type, imu_type=IMU, change=None, defined=True):
    """Write a simulation as drivers with their own messages would have recorded it."""
    store = typestore()
    for msgtype in (gnss_type, imu_type):
        if msgtype in DEFINITIONS:
            store.register({name: content for name, content in get_types_from_msg(
                DEFINITIONS[msgtype].replace(';', '\n'), msgtype).items()
                if name not in store.types})
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        imu, gnss = (writer.add_connection(topic, msgtype, **(
            {'typestore': store} if defined else {'msgdef': '', 'rihs01': 'RIHS01_0'}))
            for topic, msgtype in (('/imu', imu_type), ('/gnss', gnss_type)))
        for kind, payload in simulation.messages():
            if kind == 'imu':
                for stamp, gyro, accel in zip(*payload):
                    message = make_imu(store, stamp, gyro, accel) if imu_type == IMU else make(
                        store, imu_type, stamp, timestamp=stamp // 1000,
                        gyro_rad=gyro * (1, -1, -1), accelerometer_m_s2=accel * (1, -1, -1))
                    writer.write(imu, int(stamp), store.serialize_cdr(message, imu_type))
            elif kind == 'fix':
                fix = payload
            else:
                fields = fields_of(gnss_type, fix.stamp_ns, fix[1:4], payload.velocity.tolist())
                fields.update(change or {})
                message = make(store, gnss_type, fix.stamp_ns, **fields)
                writer.write(gnss, fix.stamp_ns, store.serialize_cdr(message, gnss_type))
    return path


@pytest.fixture(scope='module')
def simulation():
    return simulate('car', seed=3, duration=40.0, imu_grade='tactical')


@pytest.fixture(scope='module')
def expected(simulation, tmp_path_factory):
    """Return what comes of standard messages, with and without the covariance of velocities."""
    folder = tmp_path_factory.mktemp('drivers')
    write_bag(simulation, folder / 'stated')
    write_bag(replace(simulation, velocity_covariance=np.zeros((3, 3))), folder / 'none')
    return replay(folder / 'stated', CONFIG), replay(folder / 'none', CONFIG)


CONFIG = Config(lever_arm=(1.0, 1.0, 1.0), imu_grade='tactical', velocity_std=0.1,
                velocity_std_vertical=0.1)


@pytest.mark.parametrize('gnss_type, imu_type', [
    *((msgtype, IMU) for msgtype in RECEIVERS), (SENSOR_GPS, COMBINED)])
def test_same_numbers_as_with_standard_messages(simulation, expected, tmp_path, gnss_type,
                                                imu_type):
    expected = expected[gnss_type == GEODETIC]
    path = write(tmp_path / 'bag', simulation, gnss_type, imu_type)
    # The messages say what axes they have: a configured frame is not for them.
    result = replay(path, replace(CONFIG, velocity_frame='ned'))
    assert result.aligned and len(result.epochs) == len(expected.epochs) == 200
    assert result.track == pytest.approx(expected.track, abs=1e-7)
    for found, wanted in ((result.status.initial, expected.status.initial),
                          (result.status.current, expected.status.current)):
        sigma = wanted.sigma_deg
        assert found.sigma_deg == pytest.approx(sigma, rel=0.01)
        assert abs(found.roll_deg - wanted.roll_deg) < 0.02 * sigma[0]
        assert abs(found.pitch_deg - wanted.pitch_deg) < 0.02 * sigma[0]
        assert abs(found.yaw_deg - wanted.yaw_deg) < 0.02 * sigma[2]


def test_info_knows_them(simulation, tmp_path):
    info = inspect(write(tmp_path / 'bag', simulation, SENSOR_GPS, COMBINED))
    assert [(topic.name, topic.kind, topic.figures['messages']) for topic in info.topics] == [
        ('/imu', 'imu', 4001), ('/gnss', 'fix', 200), ('/gnss', 'velocity', 200)]
    assert all(topic.faults == [] for topic in info.topics)
    assert info.topics[2].figures['frame'] == 'enu'
    assert info.topics[1].figures['sigma'] == pytest.approx((2.5, 5))
    assert info.command is not None


@pytest.mark.parametrize('gnss_type, change, sentence', [
    (GEODETIC, {'latitude': 48.0}, 'latitude of septentrio_gnss_driver/PVTGeodetic comes to '
     '2750.2 deg: it must be in units of 57.2958 deg'),
    (SENSOR_GPS, {'longitude_deg': 110000000.0}, 'it must be in units of 1 deg')])
def test_wrong_units(simulation, tmp_path, gnss_type, change, sentence):
    path = write(tmp_path / 'bag', simulation, gnss_type, change=change)
    with pytest.raises(BagError, match='no position topic') as info:
        replay(path)
    assert sentence in str(info.value)
    assert sentence in inspect(path).topics[1].faults[0]


def test_missing_definition(simulation, tmp_path):
    path = write(tmp_path / 'bag', simulation, NAVPVT, defined=False)
    with pytest.raises(BagError, match='no definition of ublox_msgs/NavPVT: record as mcap'):
        replay(path)
    assert 'no definition of ublox_msgs/NavPVT' in inspect(path).topics[1].faults[0]


@pytest.mark.parametrize('msgtype, change, status, east', [
    (FIX_TYPE, {}, 0, 3.0), (FIX_TYPE, {'status': SimpleNamespace(status=-1)}, -1, 3.0),
    (NAVPVT, {}, 0, 3.0), (NAVPVT, {'fix_type': 5}, -1, 3.0), (NAVPVT, {'flags': 0}, -1, 3.0),
    (GEODETIC, {}, 0, 3.0), (GEODETIC, {'error': 1}, -1, 3.0), (GEODETIC, {'mode': 64}, -1, 3.0),
    (GEODETIC, {'ve': -2e10}, 0, math.nan), (SENSOR_GPS, {'fix_type': 1}, -1, 3.0),
    (SENSOR_GPS, {'vel_ned_valid': False}, 0, math.nan)])
def test_what_a_message_says_of_itself(msgtype, change, status, east):
    stamp_ns = 1_700_000_000_200_000_000
    stamp = SimpleNamespace(sec=stamp_ns // 10 ** 9, nanosec=stamp_ns % 10 ** 9)
    fields = {'header': SimpleNamespace(stamp=stamp), 'error': 0,
              **fields_of(msgtype, stamp_ns, (48.0, 11.0, 300.0), (3.0, 2.0, 1.0))}
    fields['status'] = SimpleNamespace(status=0)
    fix, velocity = receiver_from_msg(SimpleNamespace(**{**fields, **change}), msgtype, Config())
    assert fix.stamp_ns == velocity.stamp_ns == stamp_ns
    assert fix.status == status and fix[1:4] == pytest.approx((48.0, 11.0, 300.0))
    assert velocity.velocity[0] == pytest.approx(east, nan_ok=True)
    assert np.diag(fix.covariance) == pytest.approx(SIGMA[[0, 0, 1]] ** 2, rel=1e-3)
    assert (velocity.covariance is None) == (msgtype == GEODETIC)


def test_what_is_not_known_or_not_there():
    fields = fields_of(NAVPVT, 0, (48.0, 11.0, 300.0), (0.0, 0.0, 0.0))
    with pytest.raises(NoTimeError):
        receiver_from_msg(SimpleNamespace(**{**fields, 'valid': 5}), NAVPVT, Config())
    del fields['vel_n']
    with pytest.raises(MessageError, match='ublox_msgs/NavPVT has no field vel_n here'):
        receiver_from_msg(SimpleNamespace(**fields), NAVPVT, Config())
    fields = {**fields_of(GEODETIC, 0, (48.0, 11.0, 300.0), (0.0, 0.0, 0.0)), 'error': 0,
              'header': SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0)),
              'h_accuracy': 65535}
    fix, _ = receiver_from_msg(SimpleNamespace(**fields), GEODETIC, Config())
    assert fix.covariance is None
