# SPDX-License-Identifier: MIT
# ruff: noqa: E501 - a row is a line
"""Wrong inputs of a new user, each with the line that it must give; and a run of one of them.

A row is a command line, or a Python expression, then words that name the cause, words that name the cure, and
the exit status where it is not 1. `python tests/support/wrong_inputs.py` prints each with its line.
"""

import contextlib
import io
import os
import shlex
import shutil
import signal
import socket
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import cv2
import numpy as np
from idle_fuser import keeping
from small_recordings import kitti, seven_scenes

import tsfusion
from tsfusion.wire.keys import key_folder

SCAN = "scan"
NOBODY = "tcp://127.0.0.1:9"  # the discard port: nobody listens there, and nobody may without being root

_COMMANDS = """
# paths
replay missing | missing does not exist | expected a dataset
replay "" | an argument is empty | is a variable of the shell not set? | 2
map info small.tsf --map= | --map is empty | is a variable of the shell not set? | 2
replay empty | empty is in no layout known | `tsfusion datasets` says what each expects
replay file | file is not a folder | a file that stands for a dataset
replay photo.png | photo.png is not a folder | a file that stands for a dataset
replay garbage.zip --unpack | cannot unpack garbage.zip: File is not a zip file | get it again
replay zipped.zip | is an archive | unpack it with: unzip
replay garbage.bag | garbage.bag is no ROS bag | expected a whole .bag
replay garbage.db3 | garbage.db3 is no ROS bag | `tsfusion scan realsense:garbage.db3`
replay garbage.mcap | no keyframes in garbage.mcap | expected a state folder
replay several | holds 2 datasets | open one of them: several/a, several/b
check missing | missing does not exist | expected a dataset
check empty | in no layout known | `tsfusion datasets`
datasets list missing | missing does not exist | expected a dataset
datasets list empty | no datasets in or under empty | `tsfusion datasets` says what each layout expects
datasets list file | file is not a folder | a file that stands for a dataset
# recordings with one thing wrong
replay tum_no_depth | in no layout known | `tsfusion datasets` says what each expects
replay tum_no_poses | groundtruth.txt is missing | `tsfusion scan
replay tum_bad_pose | groundtruth.txt is no trajectory | expected 8 numbers a line (TUM)
replay tum_other_times | groundtruth.txt has no pose at the time of any frame | expected one clock
replay tum_empty_list | depth.txt lists no images | expected `timestamp path` a line
replay tum_bad_list | depth.txt:1: 'depth/a.png' | expected `timestamp path` a line
replay scenes_no_pose | 1 without a pose | expected frame-XXXXXX
replay scenes_nan_pose | pose.txt:1: not finite: nan | expected a 4×4 camera-to-world matrix
replay scenes_scaled_pose | got |RᵀR - I| = 3 | must hold a rotation
replay scenes_short_pose | pose.txt:1: 3 numbers | expected 4
replay scenes_size | is 64×48, its depth image 32×24 | expected equal sizes
replay scenes_blank | 0 of 2 keyframes fused; the keyframe has no usable sample | is the sensor covered
replay kitti --sequence 99 | kitti/sequences/99 does not exist | expected a folder in the KITTI odometry
replay kitti --sequence 06 --modality sonar | got 'sonar' | must be stereo or lidar
replay kitti_no_calib --sequence 06 | takes no `sequence` | it takes trajectory, max_gap_s
replay kitti_no_calib | has no poses | with --trajectory
check tum_no_poses | groundtruth.txt is missing | expected `timestamp tx ty tz
check scenes_nan_pose | not finite: nan | expected a 4×4 camera-to-world matrix
# options of a dataset
replay tum --sequence 06 | takes no `sequence` | it takes trajectory, max_gap_s
replay tum --option depth_topic=/x | takes no `depth_topic` | it takes trajectory, max_gap_s
replay tum --option speed | got 'speed' | must be KEY=VALUE, such as
replay tum --option self=3 | takes no `self` | it takes trajectory, max_gap_s
replay tum --option posed=maybe | `posed` must be true or false, got 'maybe' | true or false
scan tum --option posed=maybe | `posed` must be true or false, got 'maybe' | true or false
scan camera:9 --option spec=3 | takes no `spec` | it takes calibration, intrinsics
{scan} tum --sequence 06 --option sequence=06 | --sequence and --option sequence=… | give one of them
{scan} tum --trajectory x --option trajectory=y | --trajectory and --option trajectory=… | give one of them
replay tum --option unpack=no | `unpack` must be true or false, got 'no' | true or false
check tum --trajectory x --option trajectory=y | --trajectory and --option trajectory=… | give one of them
replay tum --option =3 | got '=3' | must be KEY=VALUE
replay tum --trajectory missing.txt | missing.txt is missing | expected a trajectory
replay tum --trajectory file | file is no trajectory | expected 8 numbers a line (TUM)
replay tum --trajectory other_times.txt | other_times.txt has no pose at the time of any frame | expected one clock
replay synthetic:cave | got 'cave' | world must be one of room
replay synthetic:room:sonar | got 'sonar' | must be kinect, tof, stereo or lidar
replay synthetic:room --option count=0 | got count 0 | expected count >= 1
replay synthetic:room --option focal=3 | takes no `focal` | it takes world, sensor
replay synthetic:room --option path=spiral | got 'spiral' | path must be one of circle
scan synthetic:room --option focal=3 | takes no `focal` | it takes world, sensor
replay synthetic:room --sequence 06 | a synthetic dataset takes no `sequence` | it takes world, sensor
replay synthetic:room --start 99 | none after the first 99 | has 40 keyframes
replay synthetic:room --stride 0 | '--stride' | x>=1 | 2
replay synthetic:room --rate nan | '--rate': a number is expected, got nan | see --help | 2
fuse tum --tiles nan | --tiles must be a number of metres above 0 | got nan
fuse tum --tiles 0 | --tiles must be a number of metres above 0 | got 0
map forget left --since -5 --yes | a time must be seconds before the last record | got '-5'
replay synthetic:room --rate 0 | '--rate' | x>=0.001 | 2
replay synthetic:room --rate fast | '--rate' | is not a valid float | 2
# settings of the map
replay synthetic:room --voxel-size -1 | got -1 | voxel_size must be > 0
replay synthetic:room --voxel-size 0 | got 0 | voxel_size must be > 0
replay synthetic:room --voxel-size nan | got nan | voxel_size must be > 0
replay synthetic:room --voxel-size 2cm | '--voxel-size' | is not a valid float | 2
replay synthetic:room --voxel-size 20 | 20 m is too large for max_range 5 m | 0.02 m suits a room
replay synthetic:room --voxel-size 0.0001 | too small here: the first keyframe alone would need | use 0.005 or more
replay synthetic:room --voxel-size 0.000001 | got 1e-06 | must be at least 1e-05 m
replay synthetic:room --sensor sonar | got 'sonar' | must be one of kinect
replay synthetic:room --sensor Kinect | got 'Kinect' | must be one of kinect
replay synthetic:room --regularizer very | got 'very' | must be one of off, paper, ray
replay synthetic:room --surface smooth | got 'smooth' | must be one of raw, normal, field
replay synthetic:room --lambda -1 | got -1.0 | smoothness must be >= 0
replay synthetic:room --support 3-6 | got '3-6' | must be LEAST:MOST or LEAST:MOST:BEHIND
replay synthetic:room --support 6:3 | got 3 | max_support must be at least min_support, 6 voxels
replay synthetic:room --support 3:99 | got 99 | max_support must be <= 16
replay synthetic:room --truncation 4 --support 3:6 | exclude each other | give one of them
replay synthetic:room --truncation 0 | got 0 | --truncation must be from 1 to 16 voxels
replay synthetic:room --max-range 0.05 | got 0.05 m | max_range must be larger than min_range, 0.1 m
replay synthetic:room --max-range -3 | got -3.0 | max_range must be > 0
replay synthetic:room --min-weight -1 | got -1.0 | min_weight must be >= 0
replay synthetic:room --min-weight nan | got nan | min_weight must be >= 0
replay synthetic:room --min-weight 1e9 | got 1000000000.0 | min_weight must be <= 4194304
replay synthetic:room --threads 0 | got 0 | threads must be >= 1
replay synthetic:room --threads 1000 | got 1000 | threads must be <= 256
TSFUSION_VOXEL_SIZE=big demo | TSFUSION_VOXEL_SIZE | is not a valid float | 2
TSFUSION_ENGINE=opengl demo | TSFUSION_ENGINE must be taichi or quadrants | got 'opengl'
TSFUSION_SENSOR=ear demo | got 'ear' | must be one of kinect
TSFUSION_CONFIG=missing.toml demo | missing.toml: No such file | `tsfusion config dump` writes one
serve folder --state other | --state and 'folder' are two folders | give one
ros2 publish --slice 1.8 0.1 | --slice 1.8 0.1 | expected a height and a greater one
ros2 publish --slice nan 1 | --slice nan 1 | expected a height and a greater one
# files of settings
config dump --config missing.toml | missing.toml: No such file | `tsfusion config dump` writes one
config dump --config file | file is not TOML | `tsfusion config dump` shows
config dump --config empty | empty: Is a directory | `tsfusion config dump` writes one
config dump --config photo.png | photo.png is not TOML | `tsfusion config dump` shows
config dump --config unknown.toml | unknown setting volume.speed | known are voxel_size
config dump --config typo.toml | unknown setting volume.voxel_sise | did you mean voxel_size?
config dump --config section.toml | unknown setting voxels | known are volume, server
config dump --config wrong_type.toml | got '2 cm' | volume.voxel_size must be a number
config dump --config nan.toml | got nan | voxel_size must be
config dump --config maps.toml | got 'My Map' | a map's name must be 1 to 32 of a-z
# output
replay synthetic:room --out file | it is not a folder | choose another name
replay synthetic:room --out file/out | cannot write to | choose another folder
replay synthetic:room --up 0,0 | got '0,0' | up must be x, y, z, -x, -y, -z or three numbers
replay synthetic:room --out /proc/out | cannot write to /proc/out | choose another folder
demo --out file | it is not a folder | choose another name
mesh garbage.tsf a.xyz | cannot write a.xyz | a name ending in .ply, .glb, .obj, .stl
mesh garbage.tsf a | cannot write a | a name ending in .ply
mesh garbage.tsf missing/a.ply | missing/a.ply: No such file | choose another place
mesh garbage.tsf /proc/a.ply | cannot write /proc/a.ply | choose another place
mesh garbage.tsf a.ply --map yard | --map has no effect on a saved map | give the state folder
mesh garbage.tsf folder.ply | it is a folder | choose another name
mesh garbage.tsf a.ply --preview a.gif | cannot write a.gif | a name ending in .png
mesh garbage.tsf a.ply --up w | got 'w' | up must be x, y, z, -x, -y, -z or three numbers
mesh garbage.tsf a.ply --memory all | got 'all' | expected a number of bytes such as 2GB
mesh garbage.tsf a.ply --key file | --key has no effect on garbage.tsf | only a live server
mesh garbage.tsf a.ply --control {nobody} | --control has no effect on garbage.tsf | only a live server
# servers that are not there, or are no servers
replay synthetic:room --connect {nobody} --config quick.toml --out new/folders/out | no server answers at tcp://127.0.0.1:9 (control tcp://127.0.0.1:10) | is `tsfusion serve` running there
replay synthetic:room --connect {busy} --config quick.toml | no server answers at | is `tsfusion serve` running there
replay synthetic:room --connect tcp://no-such-host.invalid:5555 --config quick.toml | no server answers at tcp://no-such-host | is the port right?
replay synthetic:room --connect 127.0.0.1:5555 | got '127.0.0.1:5555' | an address looks like tcp://127.0.0.1:5555
replay synthetic:room --connect http://127.0.0.1:5555 | got 'http://127.0.0.1:5555' | an address looks like tcp://
replay synthetic:room --connect tcp://127.0.0.1 | got 'tcp://127.0.0.1' | an address looks like tcp://127.0.0.1:5555
replay synthetic:room --connect tcp://127.0.0.1:99999 | 127.0.0.1:99999 | an address looks like tcp://127.0.0.1:5555
replay synthetic:room --connect {nobody} --map "My Map" | got 'My Map' | 1 to 32 of a-z
replay synthetic:room --connect {nobody} --voxel-size 1 | has no effect with --connect | give it to the `tsfusion serve`
replay synthetic:room --connect {nobody} --key file | key needs server_key | `tsfusion keys new`
replay synthetic:room --connect {nobody} --key file --server-key file | others can read the secret key | run `chmod 600 file`
replay synthetic:room --connect {nobody} --key missing --server-key missing | cannot read the key missing | `tsfusion keys new` makes one
replay synthetic:room --connect {nobody} --key keys/server.key --server-key keys/server.key | holds no secret key | expected a file NAME.key_secret
replay synthetic:room --key file | --key has no effect | without --connect
replay synthetic:room --control {nobody} | --control has no effect | without --connect
replay synthetic:room --connect {nobody} --state s | --state has no effect with | --connect
{scan} synthetic:room --connect {nobody} --up z | --up has no effect with | --connect
{scan} synthetic:room --connect {nobody} --voxel-size 1 | has no effect with --connect | give it to the `tsfusion serve`
replay synthetic:room --state file | cannot write the state folder file | choose another
mesh {nobody} a.ply | no server answered | is `tsfusion serve` running there
mesh nonsense://x a.ply | got 'nonsense://x' | an address looks like
mesh {nobody} a.ply --voxel-size 1 | has no effect on a live server's map | give it to `tsfusion serve`
mesh {nobody} a.ply --memory 1GB | --memory has no effect on a live server's map | give it to
mesh {nobody} a.ply --threads 1 | --threads has no effect on a live server's map | give it to
mesh {nobody} a.ply --server-key K | server_key needs key, too | key
map move yard --from {nobody} --to {nobody} --timeout 0.2 | no server answered at tcp://127.0.0.1:9 (control tcp://127.0.0.1:10) within 0.2 s | is the port right?
status --connect {nobody} --timeout 0.2 | no server answered | is the port right?
status --connect nonsense | got 'nonsense' | an address looks like
status --timeout 0 | '--timeout' | x>=0.1 | 2
status --watch 0 | '--watch' | x>=0.1 | 2
# serve
serve --listen nonsense | got 'nonsense' | an address looks like
serve --listen tcp://0.0.0.0:5555 | without keys | `tsfusion keys new server`
serve --listen {busy} | Address already in use | choose another address (--listen)
serve --state file | cannot write the state folder file | choose another
serve --metrics nonsense | got 'nonsense' | must be HOST:PORT
serve --metrics 0.0.0.0:9464 | got '0.0.0.0:9464' | on this machine, such as 127.0.0.1:9464
serve --log-level loud | got 'loud' | must be one of debug, info
serve --keys missing | server.key_secret does not exist | `tsfusion keys new server --dir missing`
serve --directory tum | cannot use the directory of maps tum: unable to open | expected a file
serve --voxel-size 20 | too large for max_range | suits a room
serve --max-range 0.01 | got 0.01 m | max_range must be larger than min_range
serve --threads 0 | got 0 | threads must be >= 1
serve --config file | file is not TOML | `tsfusion config dump` shows
# scan
{scan} nowhere | nowhere does not exist | realsense, camera:0, folder:PATH
{scan} empty | in no layout known | `tsfusion datasets`
{scan} lidar:0 | lidar:0 does not exist | realsense, camera:0, folder:PATH
{scan} folder:nowhere | nowhere is not a folder | expected one that frames are written to
{scan} folder:file | file is not a folder | expected one that frames are written to
{scan} camera:nowhere.mp4 | needs a calibration file | --calibration
{scan} camera:0 --calibration missing.yaml | missing.yaml is missing | expected Kalibr's camchain.yaml
{scan} synthetic:moon | got 'moon' | world must be one of
{scan} synthetic:room --localizer gps | got 'gps' | must be one of auto, rgbd
{scan} synthetic:room --localizer lidar | the localizer lidar follows points | this source gives depth images
{scan} synthetic:room --localizer trajectory | this localizer needs | --trajectory FILE
{scan} synthetic:room --trajectory missing.txt | missing.txt is missing | expected a trajectory
{scan} synthetic:room --trajectory file | file is no trajectory | expected 8 numbers a line (TUM)
{scan} synthetic:room --trajectory tum/depth.txt | depth.txt is no trajectory | expected 8 numbers a line (TUM)
{scan} synthetic:room --trajectory nan.txt | nan.txt:1 | expected
{scan} tum --trajectory other_times.txt --connect {nobody} | not localised in any of 3 frames | are these the same clock?
{scan} synthetic:room --feed nonsense | got 'nonsense' | an address looks like
{scan} synthetic:room --max-gap 0 | got 0.0 | max_gap must be > 0
{scan} synthetic:room --time-offset 1 | --time-offset is for poses that are looked up by time | --trajectory, --feed
{scan} synthetic:room --max-gap 1 --localizer given | --max-gap is for poses that are looked up by time | these are not
{scan} tum --trajectory other_times.txt --feed tcp://127.0.0.1:5 | two sources of poses | leave one out
{scan} synthetic:room --feed tcp://127.0.0.1:5 --localizer rgbd | --feed has no effect | --localizer rgbd
{scan} synthetic:room --trajectory x.txt --localizer rgbd | --trajectory has no effect | --localizer rgbd
{scan} synthetic:room --localizer given --loop-closure | --loop-closure needs poses | found from images
{scan} synthetic:room --time-offset soon | '--time-offset' | is not a valid float | 2
{scan} synthetic:room --min-overlap 2 | got 2.0 | min_overlap must be <= 1
{scan} synthetic:room --angle 0 | got 0.0 | angle must be > 0
{scan} synthetic:room --spool s | --spool has no effect | without --connect
{scan} synthetic:room --voxel-size 0.0001 | too small here | use 0.005 or more
{scan} tum --connect {nobody} --spool file | cannot write the spool folder | choose another
{scan} synthetic:room --option count=2 --connect {nobody} | not at the server (no server answers | but in tsfusion-spool
{scan} synthetic:corridor --option count=12 --connect {nobody} | of 12 frames were localised | move more slowly
{scan} scenes_blank --connect {nobody} | not localised in any of 2 frames | check the camera
{scan} camera:0 --rate 2 | --rate is for recordings | leave it out
{scan} realsense --rate 2 | --rate is for recordings | leave it out
{scan} synthetic:room --calibration a.yaml | a camera of its own | leave out --calibration
# other verbs
mesh missing a.ply | missing does not exist | expected a map (.tsf)
mesh empty a.ply | no keyframes in empty | expected a state folder
mesh garbage.tsf a.ply | not a tsfusion map of version 1 | expected the map.tsf of a server
mesh garbage.mcap a.ply | no keyframes in garbage.mcap | expected a state folder
mesh garbage.tsf a.ply --voxel-size 1 | --voxel-size has no effect on a saved map | fuse it anew
mesh garbage.tsf a.ply --min-weight 1e9 | got 1000000000.0 | min_weight must be <=
ate missing.txt other_times.txt | missing.txt is missing | expected a trajectory
ate file other_times.txt | file is no trajectory | expected 8 numbers a line (TUM)
ate columns.txt other_times.txt | columns.txt is no trajectory | expected 8 numbers a line (TUM)
ate nan.txt other_times.txt | nan.txt:1 | expected
ate tum/groundtruth.txt other_times.txt | no two poses are within 0.01 s | one recording and clock
ate tum/groundtruth.txt missing | missing does not exist | expected a dataset
ate tum/groundtruth.txt tum_no_poses | has no poses to compare with | give a trajectory file
ate tum/groundtruth.txt tum/groundtruth.txt --plot a.jpg | cannot write a.jpg | a name ending in .png
ate tum/groundtruth.txt tum/groundtruth.txt --max-difference -1 | '--max-difference' | x>=0 | 2
ate short.txt short.txt | got 1 and 1 | two positions or more
download kitchen | no recording 'kitchen' is known | known are tum-fr1-xyz
download --check --to empty | no archives of these recordings in empty | --to
map info missing | missing does not exist | expected a map (.tsf) or a state folder
map hash empty | no map in empty | expected a map (.tsf) or a state folder
map hash file | file is not a tsfusion map | expected the map.tsf
map merge garbage.tsf --out a.tsf | got 1 | takes two maps or more
map merge file file --out a.ply | cannot write a.ply | a name ending in .tsf
map merge garbage.tsf file --out a.tsf | garbage.tsf is not a tsfusion map | expected the map.tsf
map crop file --box 0 0 0 1 1 --out a.tsf | '--box' | a valid | 2
map crop file --box 0 0 0 1 1 1 --out folder.ply | cannot write folder.ply | a name ending in .tsf
map diff missing file | missing does not exist | expected a map (.tsf) or a state folder
map diff file file --out a.txt | cannot write a.txt | a name ending in .ply, .glb, .obj, .stl, .png
map convert file a.txt | cannot write a.txt | a name ending in .npz, .zarr, .vdb, .tsf, .ply
map convert file a.ply --dense | --dense has no effect on a.ply | only a .npz or .zarr file
map resume garbage.tsf --state s | garbage.tsf is not a tsfusion map | expected the map.tsf
map resume missing --state s | missing does not exist | expected a map (.tsf) or a state folder
journal info missing | missing does not exist | expected a state folder
journal info empty | no journal in empty | expected a state folder
journal info file | file is no journal | expected a folder or an .mcap file
journal info garbage.mcap | garbage.mcap is no MCAP file | expected a state folder
journal verify garbage.mcap | garbage.mcap is no MCAP file | expected a state folder
journal recover garbage.mcap full | garbage.mcap is no MCAP file | expected a state folder
journal recover missing out | missing does not exist | expected a state folder
journal export empty a.mcap | no journal in empty | expected a state folder
keys new "a b" --dir k | got 'a b' | a name is 1 to 32 letters
keys new robot --dir file | cannot make the folder file | choose another
keys allow robot nokey --dir keys | got 'nokey' | a public key is a file or 40 characters
keys revoke nobody --dir keys | no key is allowed under the name 'nobody' | `tsfusion keys list`
keys list --dir missing | cannot read the folder missing | `tsfusion keys new server`
doctor missing | disk | choose another folder
demo --world cave | got 'cave' | world must be one of
demo --count 0 | '--count' | x>=1 | 2
demo --seed -1 | '--seed' | x>=0 | 2
# mistyped
fly | No such command 'fly' | see --help | 2
replai synthetic:room | No such command 'replai' | Did you mean 'replay'? | 2
config dum | No such command 'dum' | Did you mean 'dump'? | 2
replay --voxel-size 0.02 | Missing argument 'PATH' | see --help | 2
scan | Missing argument 'PATH|SOURCE' | see --help | 2
config | Missing command | see --help | 2
serve --voxel-size small | '--voxel-size' | is not a valid float | 2
mesh state | Missing argument 'OUT' | see --help | 2
replay synthetic:room --fast | No such option: --fast | Possible options | 2
replay synthetic:room --voxelsize 0.02 | No such option: --voxelsize | --voxel-size | 2
# the camera
replay tum_no_camera | the camera of these 64×48 images is not known | give --intrinsics fx,fy,cx,cy
scan tum_no_camera | the camera of these 64×48 images is not known | or --calibration FILE
check tum_no_camera | is not known | give --intrinsics
replay scenes_nan_pose --intrinsics 60,60 | got '60,60' | must be fx,fy,cx,cy in pixels
replay tum --intrinsics 60,60,31.5,nan | got '60,60,31.5,nan' | must be fx,fy,cx,cy in pixels
scan tum --intrinsics 0,1,2,3 | got '0,1,2,3' | must be fx,fy,cx,cy in pixels
check tum --intrinsics a,b,c,d | got 'a,b,c,d' | must be fx,fy,cx,cy in pixels
check kitti --intrinsics 5,5,4,3 | a KITTI odometry dataset has a camera of its own | leave out --intrinsics
replay tum --intrinsics 585,585,320,240 | cx 320 lies outside of the images, which are 64×48 | in pixels of these images
replay tum --intrinsics 60,60,31.5,23.5 --calibration file | exclude each other | give one of them
replay tum --calibration missing.yaml | missing.yaml is missing | expected
replay tum --calibration file | file: could not convert | or fx fy cx cy
replay tum --calibration photo.png | photo.png is not a text file | expected
replay tum_two_cameras | contradict each other | remove one file, or give --intrinsics
replay tum_transposed_K | it is transposed | its 3×3 matrix
replay tum_other_size | is the camera of images of 64×64, but these are 64×48 | give --intrinsics
replay tum_color_camera | of the colour camera, and the depth camera has no file | give --calibration
replay tum_empty_camera | K.txt: 0 numbers | or fx fy cx cy
replay synthetic:room --intrinsics 500,500,80,60 | has a camera of its own | leave out --intrinsics
# a live page
view missing | missing does not exist | expected a server such as tcp://127.0.0.1:5555
view http://localhost:80 | got 'http://localhost:80' | an address looks like tcp://
view garbage.tsf --listen 127.0.0.1:0 | not a tsfusion map | expected the map.tsf of a server
view small.tsf --server-key a.key --key a.key_secret | cannot read the key a.key_secret | `tsfusion keys new` makes one
view small.tsf --control {nobody} | --control has no effect on small.tsf | it is no server
view {nobody} --listen 5558 | got '5558' | a map is shown at HOST:PORT, such as 127.0.0.1:5558
view {nobody} --listen 192.0.2.7:0 | cannot show a map at 192.0.2.7:0 | choose another place, such as 127.0.0.1:0
view {nobody} --listen 127.0.0.1:0 --token short | a token is | 8 to 128 letters
view {nobody} --listen 127.0.0.1:0 --truth missing.txt | got missing.txt | a truth is a mesh or points
view {nobody} --foxglove=8765 | got '8765' | a map is shown at HOST:PORT
view {nobody} --foxglove --listen 127.0.0.1:0 | --listen has no effect with --foxglove | which shows no page
serve --foxglove=192.0.2.7:80 | cannot show a map at 192.0.2.7:80 | choose another place
demo --view=nowhere | got 'nowhere' | a map is shown at HOST:PORT
replay tum --view=192.0.2.7:80 | cannot show a map at 192.0.2.7:80 | choose another place
serve --view=nowhere | got 'nowhere' | a map is shown at HOST:PORT
# what check finds
check tum --option depth_scale=1e-8 | depth is unusable | check the depth scale
check tum --option depth_scale=1 | it reads as 6.82e+03 m on average | --option depth_scale=0.001
# which way is up, islands
replay tum --up sideways | got 'sideways' | must be x, y, z
mesh garbage.tsf a.ply --up 0,0,0 | got '0,0,0' | or three numbers
scan tum --connect {nobody} --up z | --up has no effect with --connect | give it to `tsfusion mesh`
scan tum --connect {nobody} --keep-islands | --keep-islands has no effect with --connect | give it to `tsfusion mesh`
# results that are there already
demo --out full | full holds files already (file) | add --overwrite
replay tum --out full | full holds files already (file) | name a new folder
scan tum --out full | full holds files already (file) | name a new folder
# worlds and spools
scan tum --same-frame | --same-frame has no effect | without --connect
scan tum --connect {server} | has 1 keyframe of another session, in another coordinate frame | or --same-frame
replay tum --connect {server} | has 1 keyframe of another session | or --map auto
scan tum --connect {server} --map auto | no room for another map: 1 are open | with a larger max_maps
replay tum --connect {server} --map other --config quick.toml | 1 are open | use one of them
replay tum --connect {nobody} --map auto | no server answered | is the port right?
spool list --spool missing | missing is no folder | expected the one that a scan had as --spool
spool send --spool missing | missing is no folder | expected the one that a scan had as --spool
spool send other --spool left | no keyframes wait in a spool other of left | spools there: default
spool send --spool left --connect {nobody} --config quick.toml | 1 keyframe did not get through | is `tsfusion serve` running at
spool send --spool left --connect {server} | in another coordinate frame | or --same-frame
spool send default --map "My Map" --spool left --connect {server} | got 'My Map' | 1 to 32 of a-z
spool send default --map auto --spool left --connect {server} | no room for another map | with a larger max_maps
spool drop default --spool left | 1 keyframe for the map default in left/default would be deleted | say --yes
spool drop other --spool left | no keyframes wait in a spool other | spools there: default
"""

_CALLS = """
Volume(voxel_size=-1) | got -1 | voxel_size must be > 0
Volume(voxel_size="2 cm") | got '2 cm' | voxel_size must be a number
Volume(voxel_size=20) | 20 m is too large | 0.02 m suits a room
Volume(voxelsize=0.02) | unknown setting voxelsize | did you mean voxel_size?
Volume(sensor="sonar") | got 'sonar' | must be one of kinect
Volume(min_range=3, max_range=2) | got 2 m | max_range must be larger than min_range, 3 m
Volume(min_weight=float("nan")) | got nan | min_weight must be
Volume().extract_mesh(min_weight=1e9) | got 1000000000.0 | must be from 0 to
Volume().extract_mesh(surface="smooth") | got 'smooth' | must be one of raw
Volume.load("missing.tsf") | missing.tsf | No such file
Volume.load("garbage.tsf") | not a tsfusion map | expected the map.tsf of a server
Volume().save("missing/a.tsf") | cannot write the map missing/a.tsf | No such file
Keyframe(T_world_camera=pose) | got none | exactly one of depth, disparity and points
Keyframe(depth=depth, T_world_camera=pose) | got None | intrinsics must be given with depth as Intrinsics(fx, fy, cx, cy)
Keyframe(depth=depth, intrinsics=(500, 500), T_world_camera=pose) | got (500, 500) | Intrinsics(fx, fy, cx, cy)
Keyframe(depth=depth.astype("uint8"), intrinsics=K, T_world_camera=pose) | got uint8 | depth must be uint16 or float32
Keyframe(depth=depth[None], intrinsics=K, T_world_camera=pose) | got (1, 6, 8) | depth must have shape (H, W)
Keyframe(depth=depth, intrinsics=K, T_world_camera=pose[:3]) | got (3, 4) | must have shape (4, 4)
Keyframe(depth=depth, intrinsics=K, T_world_camera=2 * pose) | got |RᵀR - I| | must hold a rotation
Keyframe(depth=depth, intrinsics=K, T_world_camera=pose * float("nan")) | nan | must be finite
Keyframe(depth=depth, color=depth, intrinsics=K, T_world_camera=pose) | got uint16 | color must be uint8
Keyframe(depth=depth, depth_scale=0, intrinsics=K, T_world_camera=pose) | got 0 | depth_scale must be finite and > 0
Keyframe(disparity=depth, intrinsics=K, T_world_camera=pose) | with disparity | baseline in metres × fx in pixels
Keyframe(points=depth, T_world_camera=pose) | got uint16 | points must be float32 or float64
Keyframe(points=np.zeros((4, 2)), T_world_camera=pose) | got (4, 2) | must have shape (N, 3)
Client("127.0.0.1:5555") | got '127.0.0.1:5555' | an address looks like tcp://127.0.0.1:5555
Client(map="My Map") | got 'My Map' | 1 to 32 of a-z
Client(policy="fast") | got 'fast' | must be one of thin
open_dataset("missing") | missing does not exist | expected a dataset
open_dataset("tum", speed=3) | takes no `speed` | it takes trajectory
open_source("lidar:0") | got 'lidar:0' | source must be one of realsense
"""


class Wrong(NamedTuple):
    """A wrong input, what its line must name, and the exit status of a command."""

    line: str
    cause: str
    cure: str
    status: int = 1


def _rows(table: str) -> list[Wrong]:
    lines = [line for line in table.strip().splitlines() if not line.startswith("#")]
    cells = [line.split(" | ") for line in lines]
    return [Wrong(*each[:3], *map(int, each[3:])) for each in cells]


COMMANDS, CALLS = _rows(_COMMANDS), _rows(_CALLS)


def make_files(root: Path) -> None:
    """Write the files that the rows name, into an empty folder."""
    for name in ("empty", "keys", "full"):
        (root / name).mkdir()
    (root / "full" / "file").write_text("here first")
    (root / "file").write_text("here first")
    for name in ("garbage.tsf", "garbage.mcap", "garbage.bag", "garbage.db3", "garbage.zip", "garbage.npy"):
        (root / name).write_bytes(bytes(range(200)))
    cv2.imwrite(str(root / "photo.png"), np.zeros((6, 8, 3), np.uint8))
    with zipfile.ZipFile(root / "zipped.zip", "w") as archive:
        archive.writestr("zipped/depth.txt", "")
    (root / "folder.ply").mkdir()
    _make_settings(root)
    _make_trajectories(root)
    _make_tum(root)
    _make_scenes(root)
    _make_spool(root / "left" / "default")
    kitti(root / "kitti")
    kitti(root / "kitti_no_calib")
    (root / "kitti_no_calib" / "sequences" / "06" / "calib.txt").unlink()
    key_folder.create_pair(root / "keys", "server")
    tsfusion.Volume(0.1).save(root / "small.tsf")


def _make_settings(root: Path) -> None:
    for name, text in {
        "quick": "[client]\nconnect_timeout = 0.2\n",
        "unknown": "[volume]\nspeed = 1\n",
        "typo": "[volume]\nvoxel_sise = 0.02\n",
        "wrong_type": "[volume]\nvoxel_size = '2 cm'\n",
        "section": "[voxels]\nsize = 0.02\n",
        "nan": "[volume]\nvoxel_size = nan\n",
        "maps": "[maps.'My Map']\nvoxel_size = 0.02\n",
    }.items():
        (root / f"{name}.toml").write_text(text)


def _make_trajectories(root: Path) -> None:
    rows = [f"{5000 + i} {i} 0 0 0 0 0 1" for i in range(3)]
    (root / "other_times.txt").write_text("\n".join(rows) + "\n")
    (root / "short.txt").write_text("1000.0 0 0 0 0 0 0 1\n")
    (root / "nan.txt").write_text("1000.0 nan 0 0 0 0 0 1\n1000.1 0 0 nan 0 0 0 1\n")
    (root / "columns.txt").write_text("1000.0 0 0 0 0\n1000.1 0 0 0 0\n")


def _make_tum(root: Path) -> None:
    """A good recording in the TUM layout, and copies of it with one thing wrong each."""
    good, shape = root / "tum", (48, 64)
    v, u = np.mgrid[: shape[0], : shape[1]]
    for name in ("depth", "rgb"):
        (good / name).mkdir(parents=True)
    stamps = [f"{1000 + i / 10:.6f}" for i in range(3)]
    for i, stamp in enumerate(stamps):
        cv2.imwrite(str(good / "depth" / f"{stamp}.png"), (6000 + 20 * u + 10 * v + i).astype(np.uint16))
        color = np.dstack([u * 3 % 256, v * 5 % 256, (u * v) % 256]).astype(np.uint8)
        cv2.imwrite(str(good / "rgb" / f"{stamp}.png"), color)
    for name in ("depth", "rgb"):
        (good / f"{name}.txt").write_text("".join(f"{stamp} {name}/{stamp}.png\n" for stamp in stamps))
    (good / "groundtruth.txt").write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps))
    (good / "camera-intrinsics.txt").write_text("60 0 31.5\n0 60 23.5\n0 0 1\n")
    first = f"{stamps[0]}.png"
    for name, change in {
        "no_depth": lambda at: (shutil.rmtree(at / "depth"), (at / "depth.txt").unlink()),
        "no_color": lambda at: (shutil.rmtree(at / "rgb"), (at / "rgb.txt").unlink()),
        "no_poses": lambda at: (at / "groundtruth.txt").unlink(),
        "bad_pose": lambda at: (at / "groundtruth.txt").write_text("1000.0 0 0 0 hello\n"),
        "other_times": lambda at: shutil.copy(root / "other_times.txt", at / "groundtruth.txt"),
        "empty_list": lambda at: (at / "depth.txt").write_text(""),
        "bad_list": lambda at: (at / "depth.txt").write_text("depth/a.png\n"),
        "8bit": lambda at: cv2.imwrite(str(at / "depth" / first), np.full(shape, 90, np.uint8)),
        "cut_png": lambda at: _cut(at / "depth" / first),
        "missing_png": lambda at: (at / "depth" / first).unlink(),
        "folder_png": lambda at: ((at / "depth" / first).unlink(), (at / "depth" / first).mkdir()),
        "no_camera": lambda at: (at / "camera-intrinsics.txt").unlink(),
        "two_cameras": lambda at: (at / "K.txt").write_text("70 70 31.5 23.5"),
        "transposed_K": lambda at: (at / "camera-intrinsics.txt").write_text("60 0 0\n0 60 0\n31 23 1\n"),
        "other_size": lambda at: _replace_camera(
            at, "camera.json", '{"width": 64, "height": 64, "fx": 60, "fy": 60, "cx": 31, "cy": 31}'
        ),
        "color_camera": lambda at: _replace_camera(at, "rgb-intrinsics.txt", "60 60 31.5 23.5"),
        "empty_camera": lambda at: _replace_camera(at, "K.txt", ""),
        "color_size": lambda at: cv2.imwrite(str(at / "rgb" / first), np.zeros((24, 32, 3), np.uint8)),
    }.items():
        shutil.copytree(good, root / f"tum_{name}")
        change(root / f"tum_{name}")


def _make_spool(folder: Path) -> None:
    """A spool that a scan left, of one keyframe in a coordinate frame of its own."""
    with tsfusion.Client(NOBODY, spool=folder, world="scan-that-left-it") as client:
        client.send(_keyframe())


def _keyframe() -> tsfusion.Keyframe:
    K = tsfusion.Intrinsics(5.0, 5.0, 4.0, 3.0)
    return tsfusion.Keyframe(depth=np.full((6, 8), 900, np.uint16), intrinsics=K, T_world_camera=np.eye(4))


def _make_scenes(root: Path) -> None:
    """Recordings in the 7-Scenes layout with one thing wrong each; `several` holds two."""
    for name, ending, content in (
        ("no_pose", "pose.txt", None),
        ("nan_pose", "pose.txt", b"nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        ("scaled_pose", "pose.txt", b"2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n"),
        ("short_pose", "pose.txt", b"1 0 0\n0 1 0\n"),
        ("empty_png", "depth.png", b""),
        ("text_png", "depth.png", b"not an image"),
    ):
        seven_scenes(root / f"scenes_{name}", 1, (48, 64))
        file = root / f"scenes_{name}" / f"frame-000000.{ending}"
        file.unlink() if content is None else file.write_bytes(content)
    for name, pixels in (
        ("8bit", np.full((48, 64), 90, np.uint8)),
        ("blank", np.zeros((48, 64), np.uint16)),
        ("color_depth", np.full((48, 64, 3), 90, np.uint16)),
        ("size", np.full((24, 32), 900, np.uint16)),
    ):
        seven_scenes(root / f"scenes_{name}", 2, (48, 64))
        cv2.imwrite(str(root / f"scenes_{name}" / "frame-000000.depth.png"), pixels)
        if name == "blank":
            cv2.imwrite(str(root / f"scenes_{name}" / "frame-000001.depth.png"), pixels)
    for name in "ab":
        seven_scenes(root / "several" / name, 1, (48, 64))


def _replace_camera(at: Path, name: str, text: str) -> None:
    (at / "camera-intrinsics.txt").unlink()
    (at / name).write_text(text)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:60])


@contextlib.contextmanager
def addresses() -> Iterator[dict[str, str]]:
    """Addresses by name: `nobody` listens there, the port is `busy` with one who never answers.

    The `server` has one keyframe, of another world, in its only map, and no room for a second one.
    """
    with socket.socket() as taken, tempfile.TemporaryDirectory() as folder, _server(Path(folder)) as server:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield {
            "nobody": NOBODY,
            "busy": f"tcp://127.0.0.1:{taken.getsockname()[1]}",
            "scan": SCAN,
            "server": server,
        }


@contextlib.contextmanager
def _server(folder: Path) -> Iterator[str]:
    with keeping(folder / "state", max_maps=1) as server:
        with tsfusion.Client(server.address, world="first-scan") as client:
            client.send(_keyframe())
            client.flush(timeout=60)
        yield server.address


def run_command(line: str) -> tuple[int, str]:
    """Run a command line in this process: its exit status, and all that it printed on stderr.

    Words `NAME=VALUE` before it are its environment. A command without an error gives its stdout.
    """
    from tsfusion.cli import main

    words = shlex.split(line)
    count = next(i for i, word in enumerate(words) if "=" not in word)
    variables = dict(word.split("=", 1) for word in words[:count])
    out, err = io.StringIO(), io.StringIO()
    handlers = {signum: signal.getsignal(signum) for signum in (signal.SIGTERM, signal.SIGINT)}
    try:
        with (
            mock.patch.dict(os.environ, variables),
            mock.patch("tsfusion.wire.asking.queries._PING_TIMEOUT", 0.2),
            mock.patch("tsfusion.pipelines.runs.engine.LINGER", 0.2),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main(words[count:])
    except SystemExit as ended:
        failed = "\ntsfusion: " in f"\n{err.getvalue()}"
        return int(ended.code or 0), err.getvalue() if failed else out.getvalue() or err.getvalue()
    finally:
        for signum, handler in handlers.items():
            signal.signal(signum, handler)
    raise AssertionError("a command always exits")


def run_call(expression: str) -> str:
    """Evaluate a Python expression, which must raise one of tsfusion's errors: its message."""
    names: dict[str, Any] = {name: getattr(tsfusion, name) for name in tsfusion.__all__}
    names |= {"np": np, "pose": np.eye(4), "depth": np.full((6, 8), 900, np.uint16)}
    names["K"] = tsfusion.Intrinsics(5.0, 5.0, 4.0, 3.0)
    try:
        eval(expression, names)  # noqa: S307 - of this table
    except tsfusion.TsfusionError as error:
        return str(error)
    raise AssertionError(f"{expression} raised nothing")


def _print_all() -> None:
    with tempfile.TemporaryDirectory() as folder, addresses() as named:
        make_files(Path(folder))
        os.chdir(folder)
        for row in COMMANDS:
            line = row.line.format(**named)
            status, said = run_command(line)
            print(f"$ tsfusion {line}   [{status}]\n  {said.strip().splitlines()[-1]}", flush=True)
        for row in CALLS:
            print(f">>> {row.line}\n  {run_call(row.line)}", flush=True)
        os.chdir("/")


if __name__ == "__main__":
    sys.exit(_print_all())
