"""Videos read no other file, and frames of any size stated or hidden in them are refused."""

import shutil

import pytest

from hilsplat.base.errors import SceneError
from hilsplat.photos import video
from tests.imports.test_videos import write
from tests.unit.photos.test_intake import pan, write_video

CONCAT = "ffconcat version 1.0\nfile 'secret.mp4'\n"
HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nsecret.mp4\n#EXT-X-ENDLIST\n"


@pytest.fixture
def secret(tmp_path):
    return write_video(tmp_path / "secret.mp4", pan([0] + [6] * 12))


@pytest.mark.parametrize("content", [CONCAT, HLS])
@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_a_playlist_cannot_name_another_file(secret, tmp_path, content, suffix):
    (tmp_path / f"list{suffix}").write_text(content)
    with pytest.raises(SceneError, match=rf"list{suffix} cannot be read"):
        video.extract_frames([tmp_path / f"list{suffix}"], tmp_path, 3)


@pytest.mark.parametrize("suffix", [".gif", ".ts", ".flv"])
def test_other_containers_are_refused_whatever_the_suffix(tmp_path, suffix):
    gif = {"codec": "gif", "format": "rgb8", "options": {}} if suffix == ".gif" else {}
    write(tmp_path / f"a{suffix}", {"size": (32, 32), **gif})
    (tmp_path / f"a{suffix}").rename(tmp_path / "a.mp4")
    with pytest.raises(SceneError, match=r"a.mp4 cannot be read"):
        video.extract_frames([tmp_path / "a.mp4"], tmp_path, 3)


def test_a_file_name_is_not_a_protocol(secret, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("concat:secret.mp4|secret.mp4", "subfile,,start,0,end,0,,:secret.mp4"):
        with pytest.raises(SceneError, match="cannot be read"):
            video.extract_frames([video.Path(name)], tmp_path, 3)
    (tmp_path / "out").mkdir()
    shutil.copy(secret, "concat:x.mp4")  # an unusual name, but a file
    video.extract_frames([video.Path("concat:x.mp4")], tmp_path / "out", 3)


def test_large_frames_are_refused_before_decoding(secret, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_FRAME_PX", 1000)
    monkeypatch.setattr(video, "_decoded", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(SceneError, match=r"secret.mp4 is too large(.|\n)*320 x 240 px"):
        video.extract_frames([secret], tmp_path, 3)


def test_frames_larger_than_stated_are_not_decoded(secret, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "LIMIT", {"max_pixels": "1000"})
    # PyAV before 19 names no codec that cannot be opened
    with pytest.raises(SceneError, match=r"of video .*secret.mp4 can be decoded|secret.mp4 cannot be read"):
        video.extract_frames([secret], tmp_path, 3)
