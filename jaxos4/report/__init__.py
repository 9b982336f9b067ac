"""Reports as figures, tables, texts and HTML pages. `__init__.pyi` names them; each is imported when it is used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
