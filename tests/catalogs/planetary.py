"""Planetary image files made by hand, by the words of their standards."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.generic]
RECORD = 512


def pds3_label(pointer: str, sample: str, bits: int, shape: tuple[int, int], extra: str = "", more: str = "") -> bytes:
    """PDS3 label of one image; ``extra`` goes to the top, ``more`` into the image object."""
    lines = [
        "PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {RECORD}", f"^IMAGE = {pointer}",
        extra, "OBJECT = IMAGE", f"  LINES = {shape[0]}", f"  LINE_SAMPLES = {shape[1]}", f"  SAMPLE_TYPE = {sample}",
        f"  SAMPLE_BITS = {bits}", more, "END_OBJECT = IMAGE", "END", "",
    ]  # fmt: skip
    return "\r\n".join(lines).encode()


def prefixed(pixels: Array, before: int = 0, after: int = 0) -> bytes:
    """Rows with binary prefixes and suffixes that are no pixels."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    return bytes(np.pad(rows, ((0, 0), (before, after)), constant_values=199).tobytes())


def attached(label: bytes, data: bytes, records: int = 4) -> bytes:
    """Label padded to whole records with the pixels behind it."""
    return label.ljust(records * RECORD) + data


VICAR_FORMATS = {"u1": "BYTE", "i2": "HALF", "i4": "FULL", "f4": "REAL", "f8": "DOUB"}


def vicar(pixels: Array, properties: str = "", prefix: int = 0, header_records: int = 0, eol: str = "") -> bytes:
    """VICAR file of an image in either byte order."""
    high = pixels.dtype.byteorder == ">"
    rows, columns = pixels.shape
    record = int(columns * pixels.dtype.itemsize) + prefix
    size = -(-(800 + len(properties)) // record) * record
    label = (
        f"LBLSIZE={size}  FORMAT='{VICAR_FORMATS[pixels.dtype.str[1:]]}'  TYPE='IMAGE'  BUFSIZ={record}  DIM=3  "
        f"EOL={1 if eol else 0}  RECSIZE={record}  ORG='BSQ'  NL={rows}  NS={columns}  NB=1  N1={columns}  N2={rows}  "
        f"N3=1  N4=0  NBB={prefix}  NLB={header_records}  HOST='X'  INTFMT='{'HIGH' if high else 'LOW'}'  "
        f"REALFMT='{'IEEE' if high else 'RIEEE'}'  BHOST='X'  BINTFMT='HIGH'  BREALFMT='IEEE'  BLTYPE=''  {properties} "
    )
    whole = label.encode().ljust(size, b"\0") + b"\7" * (header_records * record) + prefixed(pixels, before=prefix)
    if eol:
        end = -(-(20 + len(eol)) // record) * record
        whole += f"LBLSIZE={end}  {eol}".encode().ljust(end, b"\0")
    return whole


def pds4_label(file: str, kind: str, shape: tuple[int, int], offset: int = 0, direction: str = "Top to Bottom",
               element: str = "", product: str = "p1", more: str = "") -> bytes:  # fmt: skip
    """PDS4 label of one image."""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" xmlns:disp="http://pds.nasa.gov/pds4/disp/v1">
  <Identification_Area>
    <logical_identifier>urn:nasa:pds:bundle:data:{product}</logical_identifier><version_id>1.0</version_id>
  </Identification_Area>
  <Observation_Area>
    {more}
    <Discipline_Area><disp:Display_Settings><disp:Display_Direction>
      <disp:horizontal_display_axis>Sample</disp:horizontal_display_axis>
      <disp:horizontal_display_direction>Left to Right</disp:horizontal_display_direction>
      <disp:vertical_display_axis>Line</disp:vertical_display_axis>
      <disp:vertical_display_direction>{direction}</disp:vertical_display_direction>
    </disp:Display_Direction></disp:Display_Settings></Discipline_Area>
  </Observation_Area>
  <File_Area_Observational>
    <File><file_name>{file}</file_name></File>
    <Array_2D_Image>
      <offset unit="byte">{offset}</offset><axes>2</axes><axis_index_order>Last Index Fastest</axis_index_order>
      <Element_Array><data_type>{kind}</data_type>{element}</Element_Array>
      <Axis_Array><axis_name>Line</axis_name><elements>{shape[0]}</elements><sequence_number>1</sequence_number></Axis_Array>
      <Axis_Array><axis_name>Sample</axis_name><elements>{shape[1]}</elements><sequence_number>2</sequence_number></Axis_Array>
    </Array_2D_Image>
  </File_Area_Observational>
</Product_Observational>
""".encode()
