"""What a woven fabric is: parameters, weaves, presets, sampling. Plain data over NumPy."""

from usdfab.fabric.fabric import (
    SYSTEMS as SYSTEMS,
)
from usdfab.fabric.fabric import (
    FabricParameters as FabricParameters,
)
from usdfab.fabric.fabric import (
    Provenance as Provenance,
)
from usdfab.fabric.fabric import (
    System as System,
)
from usdfab.fabric.fabric import (
    YarnParameters as YarnParameters,
)
from usdfab.fabric.fabric import (
    as_table as as_table,
)
from usdfab.fabric.fabric import (
    edited as edited,
)
from usdfab.fabric.fabric import (
    parse_length as parse_length,
)
from usdfab.fabric.fabric import (
    parse_size as parse_size,
)
from usdfab.fabric.parameters import (
    PARAMETER_BY_NAME as PARAMETER_BY_NAME,
)
from usdfab.fabric.parameters import (
    YARN_PARAMETERS as YARN_PARAMETERS,
)
from usdfab.fabric.parameters import (
    Parameter as Parameter,
)
from usdfab.fabric.presets import PRESETS as PRESETS
from usdfab.fabric.presets import preset as preset
from usdfab.fabric.sampling import sample_fabric as sample_fabric
from usdfab.fabric.weave import (
    NAMED_WEAVES as NAMED_WEAVES,
)
from usdfab.fabric.weave import (
    PAPER_WEAVES as PAPER_WEAVES,
)
from usdfab.fabric.weave import (
    Weave as Weave,
)
from usdfab.fabric.weave import (
    weave_from_name as weave_from_name,
)
