import math

import pytest

from prim.log.decoding.ros import decode_scan
from prim.log.messages import SCAN_TOPIC, encode_scan
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from tests.encodings.content import LogContent, delayed, read_content


@pytest.fixture(scope="session")
def content(tmp_path_factory: pytest.TempPathFactory) -> LogContent:
    """Thirty scans of a driven session, of a scanner that CARMEN knows, with all outcomes that a range can have."""
    lidar = Lidar(rays=181, fov=math.pi, range_min=0.15, range_max=1.2)
    options = SessionOptions(seed=5, motion="drive", duration=3.0, lidar=lidar)
    session = record_session(tmp_path_factory.mktemp("encodings") / "session.mcap", options)
    recorded = read_content(session.path)
    scan = decode_scan(recorded.of(SCAN_TOPIC)[0].data)
    scan.ranges[40:43] = math.nan
    messages = list(recorded.messages)
    first = next(k for k, message in enumerate(messages) if message.topic == SCAN_TOPIC)
    messages[first] = messages[first]._replace(data=encode_scan(scan))
    changed = LogContent(recorded.types, tuple(messages), recorded.metadata, recorded.attachments)
    return delayed(changed)
