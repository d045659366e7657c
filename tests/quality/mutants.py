"""Small faults for a Python file, one at a time: what `assurance.py --mutation` plants.

Each mutant changes one node of the syntax tree inside of a function, a default value of its
parameters, or a number that a module is given as a constant:

comparison   < and <=, > and >=, == and !=, is, in: the neighbour, and the opposite
arithmetic   + and -, * and /, // and *, % and *, ** and *, & and |, the operands of @ swapped
logic        and / or; not, minus and ~ dropped; a condition negated
number       one more, or twice as much beyond a thousand; True and False swapped
name         minimum and maximum, any and all, argmin and argmax, zeros and ones, sin and cos
statement    a call, a change of an element, an attribute or in place, or a raise left out;
             break and continue swapped; None returned in place of a value
argument     a keyword argument left out (not of a constructor: it would not even run)

Nothing is changed in text: messages (what is raised, logged or noted, reasons, f-strings),
docstrings, annotations, decorators.
"""

import ast
import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# What was changed, and the node that takes the other's place.
Fault = tuple[str, ast.AST]

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_SWAPS = ("minimum maximum", "min max", "any all", "argmin argmax", "zeros ones", "sin cos")
_NAMES = {a: b for pair in _SWAPS for a, b in (pair.split(), pair.split()[::-1])}
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_UNTOUCHED = {"annotation", "returns", "decorator_list", "type_comment"}
_PLAIN_CONDITIONS = (ast.Name, ast.Attribute, ast.Call, ast.NamedExpr, ast.Subscript, ast.IfExp)
_HARMLESS = {"reason", "encoding", "newline", "strict"}
_SPEAKING = {"note", "Failure", "TypeVar"}


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One fault: which field of which node becomes what."""

    path: Path
    scope: str  # qualified name of the outermost function; that of a constant is its own
    is_constant: bool
    lines: tuple[int, int]  # of the statement: what a test must run to notice
    operator: str
    before: str
    after: str
    key: str
    tree: ast.Module
    parent: ast.AST
    field: str
    index: int | None
    node: ast.AST

    def plant(self) -> None:
        """Change the tree; only once, in a process that ends with the mutant."""
        ast.copy_location(self.node, _at(self.parent, self.field, self.index))
        if self.index is None:
            setattr(self.parent, self.field, self.node)
        else:
            getattr(self.parent, self.field)[self.index] = self.node
        ast.fix_missing_locations(self.tree)


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where the walk through the tree is."""

    names: tuple[str, ...] = ()
    scope: str = ""
    digest: str = ""
    statement: ast.stmt | None = None
    is_constant: bool = False


def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a file, in the order of its lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    seen: Counter[str] = Counter()
    found = []
    for parent, field, index, place in _walk(tree, _Place()):
        old = _at(parent, field, index)
        for operator, new in _faults(old, parent, field):
            before, after = ast.unparse(old), ast.unparse(new)
            name = f"{path}::{place.scope}@{place.digest}::{operator}: {before} -> {after}"
            seen[name] += 1
            found.append(
                Mutant(
                    path=path,
                    scope=place.scope,
                    is_constant=place.is_constant,
                    lines=_lines(place.statement, old),
                    operator=operator,
                    before=before,
                    after=after,
                    key=f"{name} #{seen[name]}",
                    tree=tree,
                    parent=parent,
                    field=field,
                    index=index,
                    node=new,
                )
            )
    return found


def _at(parent: ast.AST, field: str, index: int | None) -> ast.AST:
    value = getattr(parent, field)
    found: ast.AST = value if index is None else value[index]
    return found


def _walk(parent: ast.AST, place: _Place) -> Iterator[tuple[ast.AST, str, int | None, _Place]]:
    """Yield each node that may be changed, by its place in its parent."""
    for field, value in ast.iter_fields(parent):
        if field in _UNTOUCHED:
            continue
        several = isinstance(value, list)
        for index, node in enumerate(value if several else [value]):
            if not isinstance(node, ast.AST) or _is_text(node, parent):
                continue
            inside = _enter(node, place)
            if inside.scope:
                yield parent, field, index if several else None, inside
            if not isinstance(node, ast.Raise):
                yield from _walk(node, inside)


def _enter(node: ast.AST, place: _Place) -> _Place:
    """Return the place inside of a node."""
    if place.scope:
        statement = node if isinstance(node, ast.stmt) else place.statement
        return _Place(**{**vars(place), "statement": statement})
    if isinstance(node, ast.ClassDef):
        return _Place(names=(*place.names, node.name))
    if isinstance(node, _FUNCTIONS):
        scope = ".".join((*place.names, node.name))
        return _Place(scope=scope, digest=_digest(node), statement=node)
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and not place.names:
        name = ast.unparse(node.targets[0])
        return _Place(scope=name, digest=_digest(node), statement=node, is_constant=True)
    return place


def _digest(node: ast.AST) -> str:
    return hashlib.sha256(ast.unparse(node).encode()).hexdigest()[:8]


def _lines(statement: ast.stmt | None, node: ast.AST) -> tuple[int, int]:
    """Return first and last line of a statement; of a compound one those of its head."""
    if statement is None or isinstance(statement, _FUNCTIONS):  # a default: any line may notice
        return getattr(statement, "lineno", 0), getattr(statement, "end_lineno", 0)
    body = getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else statement.end_lineno
    return statement.lineno, max(last or 0, statement.lineno)


def _is_text(node: ast.AST, parent: ast.AST) -> bool:
    """Tell whether a node only says something."""
    if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.keyword) and node.arg == "reason"):
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True
    call = node.value if isinstance(node, ast.Expr) else node
    if not isinstance(call, ast.Call):
        return False
    name = ast.unparse(call.func)
    return name in _SPEAKING or name.startswith(("_LOGGER.", "logging."))


def _faults(node: ast.AST, parent: ast.AST, field: str) -> Iterator[Fault]:
    change = _CHANGES.get(type(node))
    if change is not None:
        yield from change(node)
    is_condition = field == "test" or (field == "ifs" and isinstance(parent, ast.comprehension))
    if is_condition and isinstance(node, _PLAIN_CONDITIONS):
        yield "logic", ast.UnaryOp(op=ast.Not(), operand=node)


def _compare(node: ast.Compare) -> Iterator[Fault]:
    if len(node.ops) == 1:
        for other in _COMPARISONS[type(node.ops[0])]:
            yield (
                "comparison",
                ast.Compare(left=node.left, ops=[other()], comparators=node.comparators),
            )


def _binary(node: ast.BinOp) -> Iterator[Fault]:
    if isinstance(node.op, ast.MatMult):
        yield "arithmetic", ast.BinOp(left=node.right, op=node.op, right=node.left)
    elif type(node.op) in _ARITHMETIC:
        other = _ARITHMETIC[type(node.op)]()
        yield "arithmetic", ast.BinOp(left=node.left, op=other, right=node.right)


def _logic(node: ast.BoolOp) -> Iterator[Fault]:
    other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    yield "logic", ast.BoolOp(op=other, values=node.values)


def _unary(node: ast.UnaryOp) -> Iterator[Fault]:
    if not isinstance(node.op, ast.UAdd):
        yield "logic", node.operand


def _number(node: ast.Constant) -> Iterator[Fault]:
    if isinstance(node.value, bool):
        yield "number", ast.Constant(value=not node.value)
    elif isinstance(node.value, int | float):
        is_large = isinstance(node.value, float) and abs(node.value) > 1e3
        yield "number", ast.Constant(value=node.value * 2 if is_large else node.value + 1)


def _attribute(node: ast.Attribute) -> Iterator[Fault]:
    if node.attr in _NAMES:
        yield "name", ast.Attribute(value=node.value, attr=_NAMES[node.attr], ctx=ast.Load())


def _call(node: ast.Call) -> Iterator[Fault]:
    if isinstance(node.func, ast.Name) and node.func.id in _NAMES:
        other = ast.Name(id=_NAMES[node.func.id], ctx=ast.Load())
        yield "name", ast.Call(func=other, args=node.args, keywords=node.keywords)
    last = ast.unparse(node.func).rpartition(".")[2]
    if last == "cls" or last[:1].isupper():
        return
    for keyword in node.keywords:
        if keyword.arg and keyword.arg not in _HARMLESS:
            rest = [other for other in node.keywords if other is not keyword]
            yield "argument", ast.Call(func=node.func, args=node.args, keywords=rest)


def _in_place(node: ast.AugAssign) -> Iterator[Fault]:
    yield "statement", ast.Pass()
    if type(node.op) in _ARITHMETIC:
        other = _ARITHMETIC[type(node.op)]()
        yield "arithmetic", ast.AugAssign(target=node.target, op=other, value=node.value)


def _assign(node: ast.Assign) -> Iterator[Fault]:
    (target, *_) = node.targets
    parts = target.elts if isinstance(target, ast.Tuple) else [target]
    if all(isinstance(part, ast.Attribute | ast.Subscript) for part in parts):
        yield "statement", ast.Pass()


def _expression(node: ast.Expr) -> Iterator[Fault]:
    if isinstance(node.value, ast.Call):
        yield "statement", ast.Pass()


def _return(node: ast.Return) -> Iterator[Fault]:
    if node.value is not None and not isinstance(node.value, ast.Constant):
        yield "statement", ast.Return(value=ast.Constant(value=None))


def _leave_out(_: ast.stmt) -> Iterator[Fault]:
    yield "statement", ast.Pass()


def _jump(node: ast.Break | ast.Continue) -> Iterator[Fault]:
    yield "statement", ast.Continue() if isinstance(node, ast.Break) else ast.Break()


_CHANGES: dict[type[ast.AST], Callable[[Any], Iterator[Fault]]] = {
    ast.Compare: _compare,
    ast.BinOp: _binary,
    ast.BoolOp: _logic,
    ast.UnaryOp: _unary,
    ast.Constant: _number,
    ast.Attribute: _attribute,
    ast.Call: _call,
    ast.AugAssign: _in_place,
    ast.Assign: _assign,
    ast.Expr: _expression,
    ast.Return: _return,
    ast.Raise: _leave_out,
    ast.Delete: _leave_out,
    ast.Break: _jump,
    ast.Continue: _jump,
}
