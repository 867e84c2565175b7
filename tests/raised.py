"""Errors in a source: those of ``raise``, ``require`` and ``expect``."""

import ast


def raised(node):
    """Return the class and the message of the error that a node raises, as sources; None for other nodes."""
    match node:
        case ast.Raise(exc=ast.Call(func=error, args=[message, *_])):
            return ast.unparse(error), ast.unparse(message)
        case ast.Call(func=ast.Name("require"), args=[_, message, *error]):
            return ast.unparse(error[0]) if error else "ConfigError", ast.unparse(message)
        case ast.Call(func=ast.Name("expect"), args=[_, what, got, *remedy]):
            shown = ast.Call(ast.Name("short_repr"), [got], [])
            end = [ast.Constant(". "), *pieces(remedy[0])] if remedy else []
            message = [ast.Constant("expected "), *pieces(what), ast.Constant(", got "), *pieces(shown), *end]
            return "ConfigError", ast.unparse(ast.parse(ast.unparse(ast.JoinedStr(message))))
    return None


def pieces(text):
    match text:
        case ast.JoinedStr(values=values):
            return values
        case ast.Constant():
            return [text]
    return [ast.FormattedValue(text, -1)]
