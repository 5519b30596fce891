"""Hostile bags: ROS 1 and 2, MCAP, librealsense's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hostile
import recordings
from hostile_cases import CONTENT, Base, Case, Edit, imported, jpeg_bomb, linked, of_8_gb, piped, text_edited
from recordings import Talker


def bags(folder: Path) -> Iterator[Case]:
    folder.mkdir(parents=True, exist_ok=True)

    def spoken(name: str, storage: str, is_ros1: bool, **change: object) -> Base:
        talker = Talker(is_ros1)
        spoken = recordings.speak(talker, CONTENT, **change)
        return Base("bags", recordings.write_spoken(folder / name, talker, spoken, storage), imported)

    one, packed, lz4 = spoken("one.bag", "", True), spoken("bz2.bag", "bz2", True), spoken("lz4.bag", "lz4", True)
    mcap, db3 = spoken("two.mcap", "mcap", False), spoken("two.db3", "sqlite3", False)
    rs = Base("bags", recordings.write_realsense(folder / "rs.bag", CONTENT), imported)
    rs2 = Base("bags", recordings.write_realsense_db3(folder / "rs.db3", CONTENT), imported)
    whole = spoken("folder", "sqlite3", False)
    for base, every in ((one, 1), (packed, 2), (lz4, 2), (mcap, 1), (db3, 1), (rs, 2), (rs2, 2)):
        yield from base.damaged("", every)
    yield from whole.damaged("metadata.yaml", 2)
    meta = "metadata.yaml"
    yield whole.case("names a file outside", text_edited(meta, "- folder.db3", "- ../../beside/secret.txt"))
    yield whole.case("names /dev/zero", text_edited(meta, "- folder.db3", "- /dev/zero"))
    yield whole.case("aliases of aliases", lambda path: (path / meta).write_text(hostile.DOUBLING + "b: *a63\n"))
    yield whole.case("very deep", lambda path: (path / meta).write_text("a: " + "[" * 20000))
    yield whole.case("an unknown storage", text_edited(meta, "sqlite3", "pickle"))
    yield whole.case("packed files that are none", text_edited(meta, "compression_mode: ''", "compression_mode: FILE"))
    yield whole.case("a pipe", piped("folder.db3"))
    yield whole.case("8 GB of nothing", of_8_gb("folder.db3"), False)
    yield whole.case("its description a device", linked(meta, "/dev/zero"))
    yield whole.case("its database a device", linked("folder.db3", "/dev/zero"))
    yield whole.case("unpacks to 3 GB", _packed_folder("FILE", 3000))
    yield whole.case("messages unpack to 3 GB", _packed_folder("MESSAGE", 3000))
    yield db3.case("a row of 900 MB", _blob)
    for base, inside in ((one, ""), (mcap, ""), (db3, "")):
        yield base.case("8 GB of nothing behind", of_8_gb(inside), False)
    for size in ((2**31 - 1, 1), (65535, 65535), (0, 0)):
        yield _image_of(f"{size[0]}x{size[1]}", size)
    yield spoken_case("an encoding of its own", encoding="rgb8\n\x1b[31m")
    yield spoken_case("one line, a step of 2 GB", size=(40, 1), step=2**31)
    yield spoken_case("stamps of the year 6000", ns=126_000_000_000 * 10**9 % (2**31 * 10**9))
    for way, data in (("a PNG of 670 MB", hostile.png_bomb(False)), ("a JPEG of 3 GB", jpeg_bomb())):
        yield compressed_case(way, data)


def _packed_folder(mode: str, megabytes: int) -> Edit:
    def edit(path: Path) -> None:
        from backports.zstd import ZstdCompressor

        meta, file = path / "metadata.yaml", path / "folder.db3"
        packer, block = ZstdCompressor(level=1), bytes(hostile.MB)
        out = [packer.compress(block) for _ in range(megabytes)] + [packer.flush()]
        bomb = b"".join(out)
        text = meta.read_text().replace("compression_mode: ''", f"compression_mode: {mode}")
        meta.write_text(text.replace("compression_format: ''", "compression_format: zstd"))
        if mode == "FILE":
            file.write_bytes(bomb)
        else:
            import apsw

            with apsw.Connection(str(file)) as connection:
                connection.execute("UPDATE messages SET data = ?", (bomb,))
            connection.close()

    return edit


def _blob(path: Path) -> None:
    import apsw

    with apsw.Connection(str(path)) as connection:
        names = [row[1] for row in connection.execute("PRAGMA table_info(messages)")]
        kept = ", ".join(name for name in names if name != "data")
        connection.execute(f"CREATE TABLE old AS SELECT {kept} FROM messages; DROP TABLE messages")
        blob = "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL"
        connection.execute(f"CREATE TABLE messages ({kept}, {blob})")
        connection.execute(f"INSERT INTO messages ({kept}) SELECT {kept} FROM old")
    connection.close()


def spoken_case(name: str, **change: object) -> Case:
    """A ROS 1 bag whose colour images are odd."""

    def write(place: Path) -> Path:
        talker = Talker(True)

        def color(k: int, ns: int) -> tuple[str, object]:
            stamp = change.get("ns", ns)
            image = talker.image(stamp, recordings.FRAME["color"], CONTENT.colors[k], "rgb8")  # type: ignore[arg-type]
            image.encoding, image.step = change.get("encoding", "rgb8"), change.get("step", image.step)
            image.width, image.height = change.get("size", (image.width, image.height))  # type: ignore[misc]
            return "sensor_msgs/Image", image

        spoken = recordings.speak(talker, CONTENT, color=color)
        if "size" in change:
            spoken = _with_info(talker, spoken, change["size"])
        return recordings.write_spoken(place / "odd.bag", talker, spoken)

    return Case("bags", f"odd.bag: {name}", write, imported, not {"ns", "step"} & change.keys())


def _with_info(talker: Talker, spoken: recordings.Spoken, size: object) -> recordings.Spoken:
    info = talker.info("", size, recordings.COLOR_K, "plumb_bob", [0.0] * 5)  # type: ignore[arg-type]
    data, topic = talker.bytes("sensor_msgs/CameraInfo", info), "/camera/color/camera_info"
    return [(t, kind, ns, data if t == topic else old) for t, kind, ns, old in spoken]


def _image_of(name: str, size: tuple[int, int]) -> Case:
    return spoken_case(f"images of {name}", size=size)


def compressed_case(name: str, data: bytes) -> Case:
    def write(place: Path) -> Path:
        talker = Talker(True)

        def color(k: int, ns: int) -> tuple[str, object]:
            frame = recordings.FRAME["color"]
            return "sensor_msgs/CompressedImage", talker.compressed(ns, frame, data if k else bytes(9), "rgb8; png")

        topic = "/camera/color/image_raw/compressed"
        spoken = recordings.speak(talker, CONTENT, color=color, color_topic=topic)
        return recordings.write_spoken(place / "odd.bag", talker, spoken)

    return Case("bags", f"odd.bag: {name}", write, imported, True)
