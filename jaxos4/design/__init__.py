"""Design of flights: rotor speeds or references that make the estimate as accurate as possible within an envelope."""

from ..excitation import standard_references as standard_references
from .envelope import Envelope as Envelope
from .fleet import model_of as model_of
from .references import design_references as design_references
from .rotor_speeds import design_input as design_input
from .task import (
    AbstractTask as AbstractTask,
    Design as Design,
    Designed as Designed,
    read_input as read_input,
    read_references as read_references,
    write_input as write_input,
    write_references as write_references,
)
