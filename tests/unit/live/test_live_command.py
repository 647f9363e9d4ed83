"""`nsf view` and `nsf serve` on the command line: help, bad input, the end."""

import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request

import pytest
from test_player import wait_until

from nsf.cli import main
from nsf.live.command import _parser

LIVE = ("view", "serve")
PADDED = "c2VjcmV0c2VjcmV0=="  # base64


@pytest.fixture
def nsf(chain, monkeypatch, capsys):
    """(*arguments) → (exit code, standard output, standard error), with the tiny chain's runs."""
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    handler = signal.getsignal(signal.SIGTERM)

    def call(*arguments):
        with pytest.raises(SystemExit) as end:
            main(list(arguments))
        return (end.value.code or 0, *capsys.readouterr())

    yield call
    signal.signal(signal.SIGTERM, handler)


REFUSED = [
    (("view", "--port", "65536"), "--port=65536 must be a whole number from 0 to 65535"),
    (("view", "--port", "abc"), "--port=abc must be a whole number from 0 to 65535"),
    (("view", "--points", "0"), "--points=0 must be a whole number from 1"),
    (("view", "--frames", "30"), "unrecognized arguments"),
    (("view", "latent_dim=4"), "no key 'latent_dim'; it takes run, host, port, points"),
    (("view", "port=65536"), "--port=65536 must be a whole number from 0 to 65535"),
    (("view", "run=train/sand"), "no deploy run is, or begins with, 'train/sand'"),
    (("view", "train/sand"), "no deploy run is, or begins with, 'train/sand'"),
    (("view", "--device", "gpu"), "device=gpu"),
    (("serve", "--rate", "0"), "must be positive"),
    (("serve", "--rate", "nan"), "--rate=nan is no number"),
    (("serve", "--patience", "-1"), "must be positive"),
    (("serve", "--bench", "0"), "--bench=0 must be a whole number from 1"),
    (("serve", "--bench", "1,x"), "--bench=x must be a whole number"),
    (("serve", "--host", "no.such.host.invalid"), "cannot serve at no.such.host.invalid:8765"),
    (("serve", "--token", ""), "the token is empty; give at least 16 random ones"),
    (("serve", "--host", "0.0.0.0", "--token", ""), "the token is empty; give at least 16 random ones"),
    (("serve", "--host", "0.0.0.0", "--token", "secret"), "the token has 6 letters"),
    (("veiw",), "did you mean view?"),
]


@pytest.mark.parametrize(("arguments", "quoted"), REFUSED, ids=[" ".join(a) for a, _ in REFUSED])
def test_bad_input_is_told(nsf, arguments, quoted):
    code, _, err = nsf(*arguments)
    assert code == 2
    assert quoted in err
    assert err.startswith("error: ")
    assert "Traceback" not in err


@pytest.mark.parametrize("words", [("--token", PADDED), ("--tok", PADDED), (f"token={PADDED}",)])
def test_a_padded_token_is_no_key(words):
    options = _parser("serve", "").parse_args([*words, "rate=10", "--host", "run=x", "run=1a2b"])
    assert (options.token, options.rate, options.host, options.run) == (PADDED, 10.0, "run=x", "1a2b")


@pytest.mark.parametrize("command", LIVE)
def test_a_missing_extra_names_the_command(nsf, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "websockets", None)
    code, _, err = nsf(command)
    assert code == 2
    assert err.startswith("error: websockets cannot be imported")
    assert "pip install 'nsf[view]'" in err


@pytest.fixture
def newest(chain, tmp_path):
    """Runs of which the deployment of the tiny chain is the newest: other tests may have added some."""
    root = shutil.copytree(chain.root, tmp_path / "runs")
    for run in (root / "deploy/sand").iterdir():
        if run.name != chain.pipeline.deployment.hash:
            shutil.rmtree(run)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("command", LIVE)
def test_it_serves_until_it_is_interrupted(chain, newest, command, tmp_path):
    own = {"NSF_RUNS": str(newest), "PYTHONUNBUFFERED": "1"}
    with (tmp_path / "said").open("w+") as said:
        started = subprocess.Popen(
            [sys.executable, "-m", "nsf.cli", command, "--port", "0", "--device", "cpu"],
            stdout=said,
            stderr=subprocess.STDOUT,
            env=os.environ | own,
        )

        def told():
            return (tmp_path / "said").read_text()

        try:
            wait_until(lambda: f"{command}: open" in told() or started.poll() is not None)
            assert "the newest deployment" in told()
            assert chain.pipeline.deployment.id in told()
            (url,) = re.findall(rf"{command}: open (http://127\.0\.0\.1:\d+/?) ", told())
            with urllib.request.urlopen(url, timeout=20) as response:
                assert response.status == 200
            started.send_signal(signal.SIGINT)
            assert started.wait(20) == 0
            assert told().rstrip().endswith(f"{command}: ended")
        finally:
            started.kill()


@pytest.mark.slow
def test_beyond_this_machine_a_token_is_asked_for(newest, tmp_path):
    said = tmp_path / "said"
    with said.open("w") as stream:
        started = subprocess.Popen(
            [sys.executable, "-m", "nsf.cli", "serve", "--port", "0", "--host", "0.0.0.0", "--device", "cpu"],
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=os.environ | {"NSF_RUNS": str(newest)},
        )
        try:
            wait_until(lambda: "serve: open" in said.read_text() or started.poll() is not None)
            (port, token) = re.search(
                r"http://0\.0\.0\.0:(\d+)/\?token=(\S{20,}) ", said.read_text()
            ).groups()
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/?token={token}", timeout=20) as response:
                assert response.status == 200
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20)
        finally:
            started.kill()


def test_what_bench_measures(chain, model, player):
    pytest.importorskip("websockets", reason="websockets is not installed")
    from nsf.live.bench import follow, sizes

    found = sizes(player)
    assert found["frame"] == 2 + 4 * (3 + 4)  # t, error, bound and x̂
    assert found["positions"] == 12 * 500
    table = follow(player)
    assert table["shown step"].tolist() == [6, 12, 24]
    assert (table["frames/s"] > 0).all()
