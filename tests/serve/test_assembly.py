"""Settings to tiers: what serves, and what is said where something is missing."""

import logging
import sys
from pathlib import Path

import pytest
from support.programs import printed

from mapless_command.installation import how_to_install
from mapless_server.extras import install_hint
from mapless_server.method.features.extractors import edgepoint2, make_extractor
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.networks.weights import WeightsMissing
from mapless_server.observability.metrics import Metrics
from mapless_server.serve import features
from mapless_server.serve.devices import choose_device
from mapless_server.serve.features import ANY_ROLL_PIXELS, feature_names, make_first_features, make_tiers
from mapless_server.serve.opening import make_engine
from mapless_server.serve.startup import StartupError
from mapless_server.settings import Settings
from mapless_server.store import Store


def settings(tmp_path: Path, **values: str) -> Settings:
    return Settings(data_dir=tmp_path / "data", weights_dir=tmp_path / "weights", **values)  # type: ignore[arg-type]


def test_one_kind_of_features_is_one_tier(tmp_path: Path) -> None:
    (tier,) = make_tiers(settings(tmp_path, features="sift"))
    assert tier.extractor.name == make_first_features(settings(tmp_path, features="sift"))[1].name
    assert feature_names(settings(tmp_path, features="sift"), "cpu") == ("sift",)


def test_auto_is_the_default_and_sift_without_weights(tmp_path: Path) -> None:
    assert settings(tmp_path) == settings(tmp_path, features="auto")
    assert feature_names(settings(tmp_path), "cpu") == feature_names(settings(tmp_path), "cuda") == ("sift",)
    _, extractor = make_first_features(settings(tmp_path, features="auto"))
    assert extractor.name == make_first_features(settings(tmp_path, features="sift"))[1].name


@pytest.mark.parametrize(
    ("missing", "names", "expected"),
    [
        (
            "weights",
            "edgepoint2-l64 and aliked and aliked-lightglue",
            "run `mapless-server weights fetch edgepoint2-l64 aliked aliked-lightglue`",
        ),
        ("package", "edgepoint2-l64 and aliked", "mapless-absent is not installed: "),
    ],
)
def test_auto_leaves_out_what_is_missing_and_logs_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    missing: str,
    names: str,
    expected: str,
) -> None:
    def without_package(name: str, *arguments: object) -> object:
        if name != "sift":
            raise ModuleNotFoundError("No module named 'mapless-absent'", name="mapless-absent")
        return make_extractor(name)

    if missing == "package":
        monkeypatch.setattr(features, "find_weights", lambda name, weights_dir: weights_dir / name)
        monkeypatch.setattr(features, "make_extractor", without_package)
    with caplog.at_level(logging.INFO):
        (tier,) = make_tiers(settings(tmp_path, features="auto"))
    assert tier.extractor.name.startswith("sift")
    record, compared, adjusted = caplog.records
    assert compared.getMessage().startswith("descriptors of int8 are compared by ")
    assert adjusted.getMessage().startswith("poses are adjusted by ")
    assert expected in record.getMessage()
    assert "\n" not in record.getMessage()
    assert record.getMessage().startswith(f"features auto: sift; with {names} more ")


def test_auto_uses_the_best_features_whose_weights_are_there(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("torch")
    from safetensors.torch import save_file

    from mapless_server.networks.edgepoint2 import EdgePoint2
    from mapless_server.networks.edgepoint2_sizes import VARIANTS

    (tmp_path / "weights").mkdir()
    save_file(EdgePoint2(VARIANTS["l64"]).state_dict(), tmp_path / "weights" / "edgepoint2-l64.safetensors")
    with caplog.at_level(logging.INFO):
        for device in ("cpu", "cuda"):
            assert feature_names(settings(tmp_path), device) == ("edgepoint2-l64", "sift")
        tier, any_roll = make_tiers(settings(tmp_path, device="cpu"))
    assert (tier.any_roll, any_roll.any_roll) == (False, True)
    assert (tier.max_pixels, any_roll.max_pixels) == (None, ANY_ROLL_PIXELS)
    assert tier.extractor.name.startswith("edgepoint2-l64-")
    record, *_ = caplog.records
    assert record.getMessage().startswith("features auto: edgepoint2-l64 and sift; with aliked and aliked-")
    assert record.getMessage().endswith("run `mapless-server weights fetch aliked aliked-lightglue`")


def test_without_any_runtime_a_cpu_asks_for_the_smaller_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edgepoint2, "find_spec", lambda package: None)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.delitem(sys.modules, "mapless_server.networks.edgepoint2_onnx", raising=False)
    with pytest.raises(ImportError) as raised:
        edgepoint2.EdgePoint2Extractor("l64", tmp_path / "weights")
    assert install_hint(raised.value).endswith(how_to_install("edgepoint2"))


def test_features_named_in_the_settings_are_never_replaced(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store, pytest.raises(StartupError, match="weights fetch aliked"):
        make_engine(settings(tmp_path, features="aliked"), store, Metrics(), None)


def test_a_server_without_networks_does_not_load_torch(tmp_path: Path) -> None:
    program = """if True:
        import sys; from pathlib import Path; from mapless_server.serve.features import ANY_ROLL_PIXELS, make_tiers
        from mapless_server.settings import Settings
        make_tiers(Settings(data_dir=Path(sys.argv[1]), weights_dir=Path(sys.argv[1])))
        print('torch' in sys.modules)
    """
    assert printed(program, tmp_path) == "False\n"


def test_on_a_gpu_the_strong_features_come_first(tmp_path: Path) -> None:
    (tmp_path / "weights").mkdir()
    for name in ("aliked-n16", "edgepoint2-l64"):
        (tmp_path / "weights" / f"{name}.safetensors").touch()
    assert feature_names(settings(tmp_path), "cuda") == ("aliked", "sift")
    assert feature_names(settings(tmp_path), "cpu") == ("edgepoint2-l64", "sift", "aliked")


def test_a_missing_device_ends_the_start(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    absent = f"cuda:{torch.cuda.device_count()}"
    with Store.open(tmp_path / "data") as store, pytest.raises(StartupError, match=f"no device {absent}"):
        make_engine(settings(tmp_path, device=absent), store, Metrics(), None)
    assert choose_device("cpu") == "cpu"


def test_light_glue_matches_alone_on_gpus_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked_for: list[str] = []

    def find(name: str, weights_dir: Path) -> Path:
        looked_for.append(name)
        raise WeightsMissing(name, weights_dir)

    monkeypatch.setattr(features, "find_weights", find)
    for device in ("cpu", "cuda"):
        features._make_matcher("aliked", settings(tmp_path), device).close()
        assert looked_for == [] if device == "cpu" else ["aliked-lightglue"]


def test_a_stronger_tier_rematches_by_light_glue(tmp_path: Path) -> None:
    pytest.importorskip("kornia")
    from safetensors.torch import save_file

    from mapless_server.networks.lightglue import LightGlue

    missing: dict[str, ImportError | WeightsMissing] = {}
    without = make_matcher("aliked", 1, features._find_light_glue("aliked", settings(tmp_path), missing))
    assert without.pair_matching is None
    assert list(missing) == ["aliked-lightglue"]
    (tmp_path / "weights").mkdir()
    save_file(LightGlue(128).state_dict(), tmp_path / "weights" / "aliked-lightglue.safetensors")
    matcher = make_matcher("aliked", 1, features._find_light_glue("aliked", settings(tmp_path), missing := {}))
    assert not missing
    assert matcher.pair_matching is not None
    assert matcher.pairs.name(Matching.STRONG) not in {matcher.pairs.name(), without.pairs.name()}
