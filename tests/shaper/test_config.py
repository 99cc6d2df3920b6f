"""Every mistake in a configuration is told by file, field, value and what was expected."""

from pathlib import Path

import pytest

from shaper.address import parse_address
from shaper.config import load_config
from shaper.doorstep import read_keys
from shaper.errors import ConfigError
from shaper.incoming import Limits
from shaper.traffic_class import DEFAULT_CLASSES, Compression, Entries, Keep

EXAMPLES = Path(__file__).parents[2] / "examples"

MINIMAL = """
[link]
side = "robot"
listen = "127.0.0.1:9001"
peer = "127.0.0.1:9101"
[[link.bands]]
name = "fast"
rate_bps = 1_000_000
one_way_delay_ms = 50
[zenoh]
[[topics]]
key = "robot/**"
class = "state"
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "station.toml"
    path.write_text(text)
    return path


def error_of(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(write(tmp_path, text))
    return str(caught.value)


# What is good.


@pytest.mark.parametrize(
    ("name", "listen", "peer", "side"),
    [("robot.toml", 9001, 9101, "robot"), ("operator.toml", 9002, 9102, "operator")],
)
def test_the_examples_load(name: str, listen: int, peer: int, side: str) -> None:
    config = load_config(EXAMPLES / name)
    assert (config.listen, config.peer) == (("127.0.0.1", listen), ("127.0.0.1", peer))
    assert config.side == side
    assert [(b.name, b.rate_bps) for b in config.bands] == [("fast", 1_000_000), ("thin", 100_000)]


def test_key_files_are_found_beside_the_configuration(tmp_path: Path) -> None:
    text = MINIMAL.replace('side = "robot"', 'side = "robot"\nkeys = ["link.key", "/etc/next.key"]')
    assert load_config(write(tmp_path, text)).key_files == (tmp_path / "link.key", Path("/etc/next.key"))


@pytest.mark.parametrize("name", ["listen", "peer"])
def test_an_open_link_is_for_loopback_only(tmp_path: Path, name: str) -> None:
    text = MINIMAL.replace('side = "robot"', 'side = "robot"\nopen = true')
    assert load_config(write(tmp_path, text)).open_link
    port = {"listen": 9001, "peer": 9101}[name]
    text = text.replace(f'{name} = "127.0.0.1:{port}"', f'{name} = "192.168.1.7:{port}"')
    assert "an open link is for loopback only" in error_of(tmp_path, text)


def test_an_open_link_has_no_keys(tmp_path: Path) -> None:
    text = MINIMAL.replace('side = "robot"', 'side = "robot"\nopen = true\nkeys = ["link.key"]')
    assert "expected no link.keys beside it" in error_of(tmp_path, text)


def test_a_daemon_without_a_key_does_not_start_and_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"straitlink keygen.*link\.open"):
        read_keys(load_config(write(tmp_path, MINIMAL)))


def test_the_examples_meet_on_no_address_but_loopback() -> None:
    for name in ("robot.toml", "operator.toml"):
        config = load_config(EXAMPLES / name)
        assert config.listen[0] == "127.0.0.1"
        assert all("127.0.0.1" in endpoint for endpoint in config.bus.listen)


def test_what_is_not_given_takes_its_default(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, MINIMAL))
    assert config.endpoint.max_datagram_bytes == 1472
    assert config.endpoint.accept == ("**",)
    assert config.endpoint.limits == Limits()
    assert config.pace_ratio == 0.95
    (rule,) = config.endpoint.rules
    assert rule.traffic_class == DEFAULT_CLASSES["state"]
    assert (rule.min_period_ns, rule.compression) == (0, Compression.RAW)
    assert config.resolved["link"]["pace_ratio"] == 0.95
    assert config.resolved["topics"][0]["class"] == "state"


def test_units_are_converted(tmp_path: Path) -> None:
    config = load_config(
        write(
            tmp_path,
            MINIMAL + "max_hz = 3\n[classes.state]\nttl_ms = 1.5\n[limits]\nmax_reassembly_wait_s = 2\n",
        )
    )
    (rule,) = config.endpoint.rules
    assert rule.min_period_ns == 333_333_333
    assert rule.traffic_class.ttl_ns == 1_500_000
    assert config.endpoint.limits.max_reassembly_wait_ns == 2_000_000_000
    assert config.bands[0].one_way_delay_ns == 50_000_000


def test_a_declared_class_changes_a_built_in_one_or_adds_one(tmp_path: Path) -> None:
    text = MINIMAL.replace('class = "state"', 'class = "camera"') + (
        '[classes.camera]\ntier = 7\nkeep = "all"\ndepth = 3\n[[topics]]\nkey = "x"\nclass = "bulk"\n'
        "[classes.bulk]\nalways_send = true\n"
    )
    camera, bulk = (rule.traffic_class for rule in load_config(write(tmp_path, text)).endpoint.rules)
    assert (camera.name, camera.tier, camera.keep, camera.depth) == ("camera", 7, Keep.ALL, 3)
    assert camera.ttl_ns == DEFAULT_CLASSES["state"].ttl_ns
    assert (bulk.tier, bulk.depth, bulk.always_send) == (5, 16, True)
    assert not DEFAULT_CLASSES["bulk"].always_send


def test_what_shapes_the_traffic_is_read(tmp_path: Path) -> None:
    text = MINIMAL.replace('class = "state"', 'class = "status"\nweight = 2.5') + (
        "entries = { field = 2, key = 1, ignored = [4, 5], ignored_outside = [1] }\n"
        '[[topics]]\nkey = "robot/image"\nclass = "perception"\npull = true\nmax_hz = 2\n'
        "[tiers.4]\nguaranteed_ratio = 0.05\n[tiers.5]\nguaranteed_ratio = 0.1\n"
        '[metrics]\nlisten = "127.0.0.1:9100"\n'
        "[classes.perception]\nmax_parity_ratio = 0.25\ntarget_ratio = 0.9\n"
    )
    config = load_config(write(tmp_path, text))
    status, image = config.endpoint.rules
    assert (status.weight, image.weight) == (2.5, 1.0)
    assert status.entries == Entries(2, 1, frozenset({4, 5}), frozenset({1}))
    assert (image.pull, image.min_period_ns, image.entries) == (True, 500_000_000, None)
    assert (image.traffic_class.max_parity_ratio, image.traffic_class.target_ratio) == (0.25, 0.9)
    assert config.endpoint.guaranteed == {4: 0.05, 5: 0.1}
    assert config.metrics == ("127.0.0.1", 9100)


def test_a_class_is_made_reliable(tmp_path: Path) -> None:
    text = MINIMAL + '[classes.state]\nkeep = "all"\nreliable = true\n'
    (rule,) = load_config(write(tmp_path, text)).endpoint.rules
    assert (rule.traffic_class.reliable, rule.traffic_class.keep) == (True, Keep.ALL)


def test_rules_keep_the_order_of_the_file(tmp_path: Path) -> None:
    text = MINIMAL + '[[topics]]\nkey = "b"\nclass = "bulk"\n[[topics]]\nkey = "a"\nclass = "bulk"\n'
    rules = load_config(write(tmp_path, text)).endpoint.rules
    assert [rule.key_expression for rule in rules] == ["robot/**", "b", "a"]


def test_zenoh_options_pass_through(tmp_path: Path) -> None:
    text = MINIMAL.replace(
        "[zenoh]", '[zenoh]\nmode = "client"\n[zenoh.config]\n"transport/link/rx/buffer_size" = 9\n'
    )
    bus = load_config(write(tmp_path, text)).bus
    assert (bus.mode, dict(bus.options)) == ("client", {"transport/link/rx/buffer_size": 9})


# What is not.


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ('side = "robot"', 'side = "robto"', ["link.side", '"robto"', "'robot' or 'operator'"]),
        ('side = "robot"\n', "", ["link.side", "is missing"]),
        ("127.0.0.1:9001", "127.0.0.1", ["link.listen", '"127.0.0.1"', "expected host:port"]),
        ("127.0.0.1:9101", "127.0.0.1:0", ["link.peer", "1 to 65535"]),
        ("127.0.0.1:9101", ":9101", ["link.peer", "expected host:port"]),
        ("127.0.0.1:9101", "127.0.0.1:99999", ["link.peer", "1 to 65535"]),
        ("127.0.0.1:9101", "127.0.0.1:\N{SUPERSCRIPT TWO}", ["link.peer", "expected host:port"]),
        (
            '[[link.bands]]\nname = "fast"\nrate_bps = 1_000_000\none_way_delay_ms = 50\n',
            'estimator = "presets"\n',
            ["link.estimator", '"presets"', "at least one [[link.bands]]"],
        ),
        ("[zenoh]", "[zenoh]\nlisten = 5", ["zenoh.listen", "5", "list"]),
        ("[zenoh]\n", "", ["zenoh", "is missing"]),
        ("[zenoh]", '[zenoh]\nmode = "star"', ["zenoh.mode", '"star"', "'peer', 'client' or 'router'"]),
        (
            "rate_bps = 1_000_000",
            "rate_bps = 0",
            ["link.bands[0].rate_bps", "= 0", "greater than or equal to 1000"],
        ),
        ("rate_bps = 1_000_000", "rate_bps = 0.5", ["link.bands[0].rate_bps", "0.5", "integer"]),
        ("one_way_delay_ms = 50", "one_way_delay_ms = -1", ["link.bands[0].one_way_delay_ms", "-1"]),
        ("one_way_delay_ms = 50", "one_way_delay_ms = nan", ["link.bands[0].one_way_delay_ms", "finite"]),
        ("one_way_delay_ms = 50\n", "", ["link.bands[0].one_way_delay_ms", "is missing"]),
        ('class = "state"', 'class = "sate"', ["topics[0].class", "'sate'", "emergency, heartbeat, command"]),
        ('class = "state"\n', "", ["topics[0].class", "is missing"]),
        ('key = "robot/**"', 'key = "/robot"', ["topics[0].key", '"/robot"', "slash"]),
        ('key = "robot/**"', 'key = "robot/$*"', ["topics[0].key", "whole chunk"]),
        ('key = "robot/**"', 'key = ""', ["topics[0].key", "not empty"]),
        (
            'class = "state"',
            'class = "state"\nmax_hz = 0',
            ["topics[0].max_hz", "= 0", "greater than or equal to 0.000001"],
        ),
        ('class = "state"', 'class = "state"\nmax_hz = 1e-300', ["topics[0].max_hz", "1e-300"]),
        (
            'class = "state"',
            'class = "state"\ncompression = "gzip"',
            ["topics[0].compression", '"gzip"', "'raw' or 'zstd'"],
        ),
        ("[zenoh]", "[classes.x]\nttl_ms = 0\n[zenoh]", ["classes.x.ttl_ms", "= 0", "greater than 0"]),
        (
            "[zenoh]",
            '[classes.x]\nkeep = "some"\n[zenoh]',
            ["classes.x.keep", '"some"', "'latest', 'all' or 'changes'"],
        ),
        ("[zenoh]", "[limits]\nmax_topics = 0\n[zenoh]", ["limits.max_topics", "= 0"]),
        (
            "[zenoh]",
            "[limits]\nmax_reassembly_wait_s = 1e308\n[zenoh]",
            ["limits.max_reassembly_wait_s", "1e+308"],
        ),
        ('peer = "127.0.0.1:9101"', 'peer = "127.0.0.1:9101"\naccept = ["a//b"]', ["link.accept", "slash"]),
        ('peer = "127.0.0.1:9101"', 'peer = "127.0.0.1:9101"\npace_ratio = 1.5', ["link.pace_ratio", "1.5"]),
        (
            "[zenoh]",
            '[classes.command]\nkeep = "latest"\n[zenoh]',
            ["classes.command", "reliable = true", 'keep = "latest"', '"changes"'],
        ),
        ("[zenoh]", "[classes.x]\nmax_parity_ratio = 3\n[zenoh]", ["classes.x.max_parity_ratio", "= 3"]),
        ("[zenoh]", "[classes.x]\ntarget_ratio = 1\n[zenoh]", ["classes.x.target_ratio", "less than 1"]),
        (
            "[zenoh]",
            "[tiers.3]\nguaranteed_ratio = 0\n[zenoh]",
            ["tiers.3.guaranteed_ratio", "greater than 0"],
        ),
        ("[zenoh]", "[tiers.bulk]\nguaranteed_ratio = 0.1\n[zenoh]", ["tiers.bulk", '"bulk"', "match"]),
        ("[zenoh]", "[tiers.256]\nguaranteed_ratio = 0.1\n[zenoh]", ["tiers.256", "match"]),
        (
            "[zenoh]",
            "[tiers.3]\nguaranteed_ratio = 0.5\n[tiers.4]\nguaranteed_ratio = 0.5\n[zenoh]",
            ["tiers", "adds up to 1", "less than 1"],
        ),
        ("[zenoh]", '[metrics]\nlisten = "9100"\n[zenoh]', ["metrics.listen", '"9100"', "host:port"]),
        ('class = "state"', 'class = "state"\nweight = 0', ["topics[0].weight", "= 0"]),
        (
            'class = "state"',
            'class = "state"\npull = true',
            ["topics[0].pull", "without wildcards", "'robot/**'"],
        ),
        (
            'key = "robot/**"\nclass = "state"',
            'key = "robot/a"\nclass = "plan"\npull = true',
            ["topics[0].pull", "not reliable"],
        ),
        (
            'class = "state"',
            'class = "state"\nentries = { field = 2, key = 1 }',
            ["topics[0].entries", 'keep = "changes"'],
        ),
        (
            'class = "state"',
            'class = "status"\nentries = { field = 0, key = 1 }',
            ["topics[0].entries.field", "= 0"],
        ),
        (
            'peer = "127.0.0.1:9101"',
            'peer = "127.0.0.1:9101"\nmax_datagram_bytes = 9000',
            ["link.max_datagram_bytes"],
        ),
    ],
)
def test_a_mistake_is_told_by_file_field_value_and_expectation(
    tmp_path: Path, before: str, after: str, expected: list[str]
) -> None:
    assert before in MINIMAL
    message = error_of(tmp_path, MINIMAL.replace(before, after, 1))
    assert message.startswith(str(tmp_path / "station.toml") + ": ")
    for part in expected:
        assert part in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("section", "field", "known"),
    [
        ("", "speed", "link, zenoh, classes, tiers, metrics, operator_lost, topics, limits"),
        (
            "[link]",
            "link.speed",
            "side, listen, peer, max_datagram_bytes, pace_ratio, estimator, bands, accept",
        ),
        ("[[link.bands]]", "link.bands[0].speed", "name, rate_bps, one_way_delay_ms"),
        ("[zenoh]", "zenoh.speed", "mode, listen, connect, config"),
        ("[[topics]]", "topics[0].speed", "key, class, max_hz, compression, weight, entries, pull"),
        ("[classes.state]", "classes.state.speed", "tier, keep, ttl_ms, depth, always_send, reliable"),
        ("[classes.link]", "classes.link.speed", "tier, keep, ttl_ms, depth, always_send, reliable"),
        ("[limits]", "limits.speed", "max_topics, max_message_bytes"),
        ("[tiers.3]", "tiers.3.speed", "guaranteed_ratio"),
        ("[metrics]", "metrics.speed", "listen"),
        ("[topics.entries]", "topics[0].entries.speed", "field, key, ignored, ignored_outside"),
    ],
)
def test_an_unknown_key_is_told_with_the_known_ones(
    tmp_path: Path, section: str, field: str, known: str
) -> None:
    text = MINIMAL
    if section and section not in text:
        text += section + "\n"
    text = text.replace(section + "\n", section + "\nspeed = 5\n", 1) if section else "speed = 5\n" + text
    message = error_of(tmp_path, text)
    assert f"station.toml: {field} = 5: unknown key; expected one of {known}" in message


def test_every_mistake_is_told_on_its_own_line(tmp_path: Path) -> None:
    text = MINIMAL.replace('"robot"', '"robto"', 1).replace("1_000_000", "1").replace("9101", "0")
    lines = error_of(tmp_path, text).splitlines()
    assert [line.split(": ")[1].split(" = ")[0] for line in lines] == [
        "link.side",
        "link.peer",
        "link.bands[0].rate_bps",
    ]


def test_missing_sections_are_named(tmp_path: Path) -> None:
    lines = error_of(tmp_path, "").splitlines()
    assert [line.split(": ")[1] for line in lines] == ["link", "zenoh", "topics"]
    no_topics = MINIMAL.split("[[topics]]")[0]
    assert "topics: is missing" in error_of(tmp_path, no_topics)
    assert "at least 1 item" in error_of(tmp_path, "topics = []\n" + no_topics)


def test_a_long_value_is_cut_in_the_message(tmp_path: Path) -> None:
    message = error_of(tmp_path, MINIMAL.replace("127.0.0.1:9001", "x" * 5000))
    assert "link.listen = " in message.split(": expected")[0]
    assert len(message.split(": expected")[0]) < 250


def test_what_is_not_toml_is_told_with_the_line(tmp_path: Path) -> None:
    message = error_of(tmp_path, "[link\n")
    assert "station.toml: is not TOML: " in message
    assert "line 1" in message


def test_bytes_that_are_no_text_are_not_toml(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is not TOML"):
        load_config(path)


def test_a_missing_file_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: cannot be read: No such file"):
        load_config(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:9001", ("127.0.0.1", 9001)),
        ("[::1]:9001", ("::1", 9001)),
        ("robot.local:65535", ("robot.local", 65535)),
    ],
)
def test_addresses_are_host_and_port(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text) == address


def test_prediction_goes_with_the_adaptive_estimator(tmp_path: Path) -> None:
    text = MINIMAL.replace(
        'side = "robot"', 'side = "robot"\nopen = true\nestimator = "adaptive"\npredict = true'
    )
    assert load_config(write(tmp_path, text)).predict
    wrong = error_of(tmp_path, text.replace('"adaptive"', '"presets"'))
    assert wrong.endswith('link.predict = true: expected link.estimator = "adaptive" with it')
