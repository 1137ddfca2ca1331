# SPDX-License-Identifier: MIT
"""List the public recordings that `tsfusion download` knows: addresses, sizes and licences.

A checksum is published by the publisher, or else by independent users of the same archive. None = not known;
the first download then stores its own checksum.
"""

from typing import NamedTuple

from tsfusion.core.errors import DatasetError

_TUM = "https://cvg.cit.tum.de/rgbd/dataset"
_TUM_PAGE = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/download"
_ICL_PAGE = "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html"
_SEVEN = "https://download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"
_SEVEN_PAGE = "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/"
_OPEN3D = "https://github.com/isl-org/open3d_downloads/releases/download"
_OPEN3D_PAGE = "https://www.open3d.org/docs/release/tutorial/data/index.html"
_ETH = "https://www.research-collection.ethz.ch/server/api/core/bitstreams"
_ETH_PAGE = "https://doi.org/10.3929/ethz-b-000690084"
_CORBS = "http://corbs.dfki.uni-kl.de/suppfiles/ElectricalCabinet/E1"


class File(NamedTuple):
    """File to download."""

    url: str
    name: str  # of the file on disk and at a mirror
    checksum: str | None = None  # `sha256:…` or `md5:…`; None = unknown
    into: str = ""  # subfolder that an archive is unpacked to


class PublicRecording(NamedTuple):
    """Entry of the catalogue.

    Attributes:
        files: files to download; empty = the user must fetch it by hand, and `note` gives the reason.
        nbytes: size of all files; None = unknown.
        opens: path to give to `open_dataset`, relative to the folder of the unpacked files.
    """

    name: str
    title: str
    page: str
    licence: str
    files: tuple[File, ...] = ()
    nbytes: int | None = None
    opens: str = ""
    note: str = ""


def _tum(name: str, sequence: str, nbytes: int | None, checksum: str | None = None) -> PublicRecording:
    archive = f"rgbd_dataset_{sequence}.tgz"
    url = f"{_TUM}/{sequence.split('_', maxsplit=1)[0]}/{archive}"
    title = f"TUM RGB-D {sequence}: Kinect, motion capture"
    files = (File(url, archive, checksum),)
    return PublicRecording(name, title, _TUM_PAGE, "CC BY 4.0", files, nbytes, f"rgbd_dataset_{sequence}")


def _icl(number: int, nbytes: int | None = None) -> PublicRecording:
    archive = f"living_room_traj{number}_frei_png.tar.gz"
    return PublicRecording(
        f"icl-nuim-living-room-{number}",
        f"ICL-NUIM living room, trajectory {number}: rendered without noise, exact poses",
        _ICL_PAGE, "CC BY 3.0", (File(f"https://www.doc.ic.ac.uk/~ahanda/{archive}", archive),), nbytes,
    )  # fmt: skip


def _seven(scene: str) -> PublicRecording:
    return PublicRecording(
        f"7scenes-{scene}", f"7-Scenes {scene}: Kinect, several sequences", _SEVEN_PAGE,
        "Microsoft Research, non-commercial", (File(f"{_SEVEN}/{scene}.zip", f"{scene}.zip"),), opens=scene,
    )  # fmt: skip


def _euroc(bundle: str, bitstream: str, md5: str, nbytes: int, first: str) -> PublicRecording:
    file = File(f"{_ETH}/{bitstream}/content", f"{bundle}.zip", f"md5:{md5}")
    title = f"EuRoC {bundle}: stereo of a drone, all its sequences (folders and bags)"
    name = f"euroc-{bundle.replace('_', '-').replace('vicon-', '')}"
    return PublicRecording(name, title, _ETH_PAGE, "non-commercial", (file,), nbytes, f"{bundle}/{first}")


CATALOGUE: tuple[PublicRecording, ...] = (
    _tum("tum-fr1-xyz", "freiburg1_xyz", 448_204_271,
         "sha256:a0236d97b8c30cd93b653656d2b6c293ff7c982a4130ef2a1a8beecdb124ef98"),
    _tum("tum-fr1-desk", "freiburg1_desk", 344_011_403,
         "sha256:e983d6830916e66dc4a46a71368046b149b283de87769690e7aa4e0b9483530c"),
    _tum("tum-fr1-room", "freiburg1_room", 782_381_450),
    _tum("tum-fr2-xyz", "freiburg2_xyz", None),
    _tum("tum-fr2-desk", "freiburg2_desk", 1_893_351_095),
    _tum("tum-fr3-office", "freiburg3_long_office_household", 1_483_556_251),
    _icl(0), _icl(1), _icl(2, 429_825_445), _icl(3),
    *map(_seven, ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")),
    PublicRecording(
        "redwood-sample", "Redwood living room: five RGB-D frames, as Open3D ships them", _OPEN3D_PAGE,
        "see the page",
        (File(f"{_OPEN3D}/20220301-data/SampleRedwoodRGBDImages.zip", "SampleRedwoodRGBDImages.zip",
              "md5:43971c5f690c9cfc52dda8c96a0140ee"),),
    ),
    PublicRecording(
        "redwood-lounge", "Stanford lounge: 3000 RGB-D frames with a trajectory", _OPEN3D_PAGE,
        "see the page",
        (File(f"{_OPEN3D}/20220301-data/LoungeRGBDImages.zip", "LoungeRGBDImages.zip",
              "md5:cdd307caef898519a8829ce1b6ab9f75"),),
    ),
    PublicRecording(
        "redwood-livingroom1", "Augmented ICL-NUIM living room 1: 2870 RGB-D frames, simulated noise",
        _OPEN3D_PAGE, "see the page",
        (File(f"{_OPEN3D}/augmented-icl-nuim/livingroom1-color.zip", "livingroom1-color.zip",
              "md5:c23481094ca3859b204d2fcbb4e435a4", "color"),
         File(f"{_OPEN3D}/augmented-icl-nuim/livingroom1-depth-simulated.zip",
              "livingroom1-depth-simulated.zip", "md5:2fec03a29258a29b9ffedde88fddd676", "depth"),
         File(f"{_OPEN3D}/augmented-icl-nuim/livingroom1-traj.txt", "livingroom1-traj.txt",
              "md5:601ac4b51aba2455a90aed8aa1158c6a")),
    ),
    _euroc("vicon_room1", "02ecda9a-298f-498b-970c-b7c44334d880",
           "5ce06b405827e453a82523d3ca9c2fd0", 6_042_263_426, "V1_01_easy"),
    _euroc("vicon_room2", "ea12bc01-3677-4b4c-853d-87c7870b8c44",
           "c6347f4e0476aaa9a43a919c163c49c5", 6_013_384_949, "V2_01_easy"),
    _euroc("machine_hall", "7b2419c1-62b5-4714-b7f8-485e5fe3e5fe",
           "363f5c2502b469cdd97ef85997714806", 12_683_729_426, "MH_01_easy"),
    PublicRecording(
        "replica", "Replica rendered for NICE-SLAM: eight rooms, exact poses",
        "https://github.com/cvg/nice-slam", "Replica Research Terms, non-commercial",
        (File("https://cvg-data.inf.ethz.ch/nice-slam/data/Replica.zip", "Replica.zip"),),
        opens="Replica/room0",
    ),
    PublicRecording(
        "corbs-e1", "CoRBS electrical cabinet E1: Kinect v2, pre-registered",
        "http://corbs.dfki.uni-kl.de", "see the page",
        (File(f"{_CORBS}/E1_pre_registereddata.zip", "E1_pre_registereddata.zip"),
         File(f"{_CORBS}/E1_Trajectory.zip", "E1_Trajectory.zip")),
        opens="E1_pre_registereddata",
    ),
    PublicRecording(
        "bunny", "Stanford bunny: ten range scans and the mesh (for accuracy, not for replay)",
        "https://graphics.stanford.edu/data/3Dscanrep/", "research, with acknowledgement",
        (File("https://graphics.stanford.edu/pub/3Dscanrep/bunny.tar.gz", "bunny.tar.gz",
              "sha256:a5720bd96d158df403d153381b8411a727a1d73cff2f33dc9b212d6f75455b84"),),
        opens="bunny",
    ),
    PublicRecording(
        "kitti-odometry", "KITTI odometry: stereo and Velodyne of a car",
        "https://www.cvlibs.net/datasets/kitti/eval_odometry.php", "CC BY-NC-SA 3.0",
        note="its makers ask for a registration; unpack what you get there into one folder",
    ),
)  # fmt: skip


def entry(name: str) -> PublicRecording:
    """Return the recording with a name.

    Raises:
        DatasetError: the name is unknown. The message lists the known names.
    """
    for one in CATALOGUE:
        if one.name == name:
            return one
    raise DatasetError(f"no recording {name!r} is known; known are {', '.join(e.name for e in CATALOGUE)}")
