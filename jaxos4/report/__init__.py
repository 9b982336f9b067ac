"""Reports: figures, tables and an HTML page of a study; a page and a text of an identification.

The names are in `__init__.pyi`. Each is imported when it is first used: text needs no Matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
