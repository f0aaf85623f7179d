"""What a woven fabric is: parameters, weaves, presets, sampling. Plain data over NumPy."""

from usdfab.fabric.draft import Draft as Draft, DraftYarns as DraftYarns, with_draft as with_draft
from usdfab.fabric.fabric import (
    SYSTEMS as SYSTEMS,
    Color as Color,
    FabricParameters as FabricParameters,
    Provenance as Provenance,
    System as System,
    YarnParameters as YarnParameters,
    as_table as as_table,
    edited as edited,
    parse_length as parse_length,
    parse_size as parse_size,
)
from usdfab.fabric.mix import mixed as mixed
from usdfab.fabric.parameters import (
    PARAMETER_BY_NAME as PARAMETER_BY_NAME,
    YARN_PARAMETERS as YARN_PARAMETERS,
    Parameter as Parameter,
)
from usdfab.fabric.plies import ply_circles as ply_circles, ply_fill as ply_fill
from usdfab.fabric.presets import PRESETS as PRESETS, preset as preset
from usdfab.fabric.recolor import hex_color as hex_color, parse_color as parse_color, recolored as recolored
from usdfab.fabric.sampling import sample_fabric as sample_fabric
from usdfab.fabric.weave import (
    NAMED_WEAVES as NAMED_WEAVES,
    PAPER_WEAVES as PAPER_WEAVES,
    Weave as Weave,
    weave_from_name as weave_from_name,
)
from usdfab.fabric.wif import read_wif as read_wif
from usdfab.fabric.wif_write import write_wif as write_wif
