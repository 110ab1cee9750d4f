"""The generated part of the documentation, which is always what the code says.

    python -m docs.generate [--check]                         the reference: its pages and the JSON schema
    python -m docs.generate.method_pictures [NAME ...]        the pictures of docs/method/paper.md
    python -m docs.generate.route_pictures [NAME ...]         those of docs/behaviour/any-angle.md and fly.md

A page is a template in `templates/`, which holds its prose; declarations fill its tables. A key, message, command
or option which the code has is on its page, with the words of its docstring. `site` is what MkDocs loads: pages of
the Python API, and the design pages.
"""
