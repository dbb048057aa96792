"""Image files: bytes to pixels, keywords of the label, and the product's own bad-pixel flags.

Formats are told by content: FITS, VICAR, ISIS cubes, PDS3 with the label in front, and PDS3 or PDS4 with the label in
a file of its own.
"""

from collections.abc import Iterator, Mapping

from catalogs.fits_images import read_fits
from catalogs.gdal_images import isis_pixels, pds4_file, pds4_pixels, scaled, special_pixels, vicar_pixels
from catalogs.instruments import CardValue, Header
from catalogs.label_text import Keywords, attached_label, parse_label, parse_pds4, parse_vicar
from catalogs.pds3_images import Pointer, pds3_pixels, pointer_of
from catalogs.raw_images import RawImage
from pipeline.errors import ImageError
from pipeline.records import Image
from pipeline.status import StatusReason

__all__ = ["RawImage", "labelled_file", "read_image"]

# How labels begin: PDS3, its predecessors on the first disks, and ISIS cubes.
_KEYWORD_STARTS = (b"PDS_VERSION_ID", b"CCSD3", b"NJPL", b"ODL_VERSION_ID", b"FILE_TYPE", b"RECORD_TYPE", b"Object")
_MISSING_KEYS = ("IMAGE.MISSING_CONSTANT", "IMAGE.INVALID_CONSTANT", "IMAGE.MISSING", "IMAGE.NULL_CONSTANT")


class _Joined(Mapping[str, CardValue]):
    """Cards of a header, and keywords of a label beside it for what the cards do not say."""

    def __init__(self, cards: Header, keywords: Header) -> None:
        self._cards, self._keywords = cards, keywords

    def __getitem__(self, key: str) -> CardValue:
        value = self._cards.get(key)
        return self._keywords[key] if value is None else value

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._cards, *self._keywords)))

    def __len__(self) -> int:
        return len(dict.fromkeys((*self._cards, *self._keywords)))


def read_image(data: bytes, name: str, companions: Mapping[str, bytes] | None = None) -> RawImage:
    """Read an image from the bytes of its file.

    Parameters
    ----------
    data
        The whole file: pixels, or a label that names the file of its pixels.
    name
        For messages.
    companions
        Files that belong to it, by name: its detached label, or the pixels of a label.

    Returns
    -------
    RawImage
        The first two-dimensional image of the file.

    Raises
    ------
    ImageError
        If the file is empty, truncated, of a format that is not read, damaged, or lacks the file that its label names.
    """
    if not data:
        raise ImageError(StatusReason.IMAGE_EMPTY, f"{name} has no bytes")
    companions = companions or {}
    named = labelled_file(data)
    if named is not None:
        pixels = next((found for file, found in companions.items() if file.lower() == named.lower()), None)
        if pixels is None:
            raise ImageError(StatusReason.IMAGE_NOT_FOUND, f"{name}: {named}, which it names, is not there")
        return read_image(pixels, named, {name: data})
    label = next((text for text in companions.values() if _is_label(text)), None)
    try:
        return _read(data, name, label)
    except ValueError as error:
        raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {' '.join(str(error).split())}") from error


def _is_label(data: bytes) -> bool:
    return data.lstrip()[:32].startswith((*_KEYWORD_STARTS, b"<?xml", b"<Product"))


def _is_xml(data: bytes) -> bool:
    return data.lstrip()[:9].startswith((b"<?xml", b"<Product"))


def labelled_file(data: bytes) -> str | None:
    """Name of the file whose pixels a label describes, where that is another file.

    Parameters
    ----------
    data
        Any file.

    Returns
    -------
    str or None
        Without folders; None where the file is no label, holds its own pixels, or cannot be understood.
    """
    if not _is_label(data):
        return None
    try:
        if _is_xml(data):
            return pds4_file(parse_pds4(data))
        text = attached_label(data)
        pointer = None if text is None else pointer_of(_flat(text))
    except ValueError:
        return None
    return None if pointer is None or pointer.file is None else pointer.file.rpartition("/")[2]


def _flat(text: str) -> Keywords:
    return parse_label(text).flat()


def _read(data: bytes, name: str, label: bytes | None) -> RawImage:
    beside: Keywords = {}
    if label is not None:
        beside = parse_pds4(label) if _is_xml(label) else _flat(attached_label(label) or label.decode("latin-1"))
    if data.startswith(b"SIMPLE  ="):
        raw = read_fits(data, name)
        return RawImage(raw.pixels, _Joined(raw.header, beside), raw.extensions) if beside else raw
    if data.startswith(b"LBLSIZE="):
        own = _vicar_label(data)
        return RawImage(vicar_pixels(data, own, name), own | beside, {})
    if data.startswith(_KEYWORD_STARTS) and (text := attached_label(data)) is not None:
        return _read_labelled(data, _flat(text), beside, name)
    if label is not None and _is_xml(label):
        return RawImage(pds4_pixels(data, label, beside, name), beside, {})
    if label is not None:
        return RawImage(_pds3(data, beside, pointer_of(beside), name), beside, {})
    raise ImageError(
        StatusReason.IMAGE_FORMAT_UNKNOWN,
        f"{name} is neither FITS, VICAR, ISIS nor PDS: it starts with {data[:8]!r} and has no label",
    )


def _read_labelled(data: bytes, own: Keywords, beside: Keywords, name: str) -> RawImage:
    """Image with its keywords in front."""
    if "IsisCube.Core.StartByte" in own:
        return RawImage(isis_pixels(data, own, name), own | beside, {})
    pointers = (pointer_of(own, key) for key in ("IMAGE_HEADER", "VICAR_HEADER"))
    vicar = next((p.offset for p in pointers if p is not None), None)
    inner = _vicar_label(data[vicar:]) if vicar and data.startswith(b"LBLSIZE=", vicar) else {}
    return RawImage(_pds3(data, own, pointer_of(own), name), inner | own | beside, {})


def _pds3(data: bytes, header: Keywords, pointer: Pointer | None, name: str) -> Image:
    if pointer is None:
        raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: its label points to no image")
    pixels = pds3_pixels(data, header, pointer.offset, name)
    scale, offset = header.get("IMAGE.SCALING_FACTOR", 1.0), header.get("IMAGE.OFFSET", 0.0)
    constants = [header[key] for key in _MISSING_KEYS if key in header]
    special = special_pixels(pixels, [float(value) for value in constants if isinstance(value, int | float)])
    return scaled(
        pixels, float(scale) if isinstance(scale, int | float) else 1.0,
        float(offset) if isinstance(offset, int | float) else 0.0, special,
    )  # fmt: skip


def _vicar_label(data: bytes) -> Keywords:
    """A VICAR file's label, with the part behind its pixels (EOL) where it has one."""
    size = data[8:40].split()[0]
    length = int(size) if size.isdigit() else 0
    label = parse_vicar(data[:length].decode("latin-1"))
    figures = [label.get(key) for key in ("RECSIZE", "NLB", "N2", "N3")]
    if label.get("EOL") == 1 and all(isinstance(f, int) for f in figures):
        record, header, rows, bands = (int(f or 0) for f in figures)
        rest = data[length + record * (header + rows * bands) :]
        if rest.startswith(b"LBLSIZE="):
            more = rest[8:40].split()[0]
            label = label | {
                key: value
                for key, value in parse_vicar(rest[: int(more) if more.isdigit() else 0].decode("latin-1")).items()
                if key not in label
            }
    return label
