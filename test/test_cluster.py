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
"""Replay of several recordings on a Dask cluster, one worker of which dies on the way."""

import contextlib
from importlib.util import find_spec
import json
import os
import signal
import socket
import sys
import threading
import time

from ins_align.cli import main
from ins_align.simulation.simulate import simulate, write_bag
import pytest

pytestmark = pytest.mark.skipif(find_spec('distributed') is None, reason='no distributed')


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'flight'
    write_bag(simulate('flight', imu_grade='tactical', seed=2, duration=20.0), path)
    return path


@pytest.fixture(scope='module')
def cluster():
    from distributed import LocalCluster
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True,
                      dashboard_address=None) as local:
        yield local


def kill_a_busy_worker(cluster, killed):
    """Kill a worker process that works on a recording."""
    from distributed import Client
    with Client(cluster) as client:
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and not killed:
            time.sleep(0.05)
            busy = [address for address, keys in client.processing().items() if keys]
            if busy and len(client.has_what()) == 2:
                pid = client.run(os.getpid, workers=busy[:1])[busy[0]]
                time.sleep(0.3)
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)


def test_a_worker_is_no_scheduler(cluster, flight, capsys):
    worker = next(iter(cluster.scheduler_info['workers']))
    assert main(['replay', str(flight), '--dask', worker]) == 2
    assert f'no Dask scheduler answers at {worker} (OSError: it is no' in capsys.readouterr().err


def test_a_worker_dies(cluster, flight, tmp_path, capsys, monkeypatch):
    bags = []
    for number in range(6):
        bags.append(f'flight_{number}')
        (tmp_path / bags[-1]).symlink_to(flight)
    bags.insert(3, 'missing')
    monkeypatch.chdir(tmp_path)
    here = [*bags, '--set', 'imu_grade=tactical', '--csv', 'rows.csv']
    assert main(['replay', *here, '--json', 'here.json']) == 2
    alone = capsys.readouterr()
    tables = {path.name: path.read_text('ascii') for path in tmp_path.glob('rows_*.csv')}
    for path in tmp_path.glob('rows_*.csv'):
        path.unlink()

    killed = []
    killer = threading.Thread(target=kill_a_busy_worker, args=(cluster, killed))
    killer.start()
    status = main(['replay', *here, '--json', 'there.json', '--dask',
                   cluster.scheduler_address])
    killer.join()
    there = capsys.readouterr()
    assert len(killed) == 1
    assert status == 2
    # Everything once, in order, as without a cluster.
    assert [done['bag'] for done in json.loads((tmp_path / 'there.json').read_text())] == bags
    assert (tmp_path / 'there.json').read_text() == (tmp_path / 'here.json').read_text()
    assert there.out == alone.out
    assert 'missing does not exist' in there.err
    assert len(tables) == 6
    assert {path.name: path.read_text('ascii') for path in tmp_path.glob('rows_*.csv')} == tables
    assert not list(tmp_path.glob('.*.part'))


def test_no_cluster_there(flight, capsys, monkeypatch):
    monkeypatch.setattr('ins_align.processes.CONNECT_TIMEOUT', 0.5)
    assert main(['replay', str(flight), '--dask', 'tcp://127.0.0.1:9']) == 2
    error = capsys.readouterr().err
    assert 'no Dask scheduler answers at tcp://127.0.0.1:9' in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize('greeting', [b'', b'SSH-2.0-OpenSSH_9.6\r\n'])
def test_something_else_is_there(flight, capsys, monkeypatch, greeting):
    monkeypatch.setattr('ins_align.processes.CONNECT_TIMEOUT', 1.0)
    callers = []
    with socket.create_server(('127.0.0.1', 0)) as server:

        def greet():
            with contextlib.suppress(OSError):
                while True:
                    callers.append(server.accept()[0])
                    callers[-1].sendall(greeting)

        threading.Thread(target=greet, daemon=True).start()
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'
        assert main(['replay', str(flight), '--dask', address]) == 2
        server.shutdown(socket.SHUT_RDWR)
    assert callers
    error = capsys.readouterr().err
    assert error.startswith(f'ins_align replay: no Dask scheduler answers at {address} (')
    assert error.count('\n') == 1
    for caller in callers:
        caller.close()


@pytest.mark.parametrize('address', ['localhost', 'tcp://127.0.0.1', 'x://localhost:1', ''])
def test_address_that_is_none(flight, capsys, address):
    assert main(['replay', str(flight), '--dask', address]) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and 'an address is like tcp://localhost:8786' in error


def test_dask_is_not_installed(flight, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert main(['replay', str(flight), '--dask', 'tcp://127.0.0.1:9']) == 2
    assert 'pip install distributed' in capsys.readouterr().err
