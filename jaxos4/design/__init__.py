"""What to fly: inputs that tell the most about the parameters, within what the vehicle may do."""

from .closed_loop import DesignedReferences as DesignedReferences, design_references as design_references
from .comparison import (
    InputDesign as InputDesign,
    ReferenceDesign as ReferenceDesign,
    design_and_compare as design_and_compare,
    design_and_compare_references as design_and_compare_references,
)
from .envelope import Envelope as Envelope
from .filtered import model_of as model_of
from .fitting import DesignedInput as DesignedInput
from .input_file import read_input as read_input, write_input as write_input
from .open_loop import design_input as design_input, envelope_of as envelope_of
from .reference_file import read_references as read_references, write_references as write_references
from .references import standard_references as standard_references
