//! What a pickle asks for, found out before libtorch follows it.
//!
//! A pickle is a program for a small stack machine. libtorch's machine runs no foreign code, but trusts the program's
//! bookkeeping: that what is taken from the stack is there, that a memo isn't numbered in the billions, that lists in lists
//! end somewhere. So the program is walked through here without making anything: only the instructions that torch.save needs
//! for tensors, lists, dicts, strings and numbers pass, and only in a sound order.

/// Lists, dicts and tuples in each other: a chunk has three, and a tensor's description two more.
const MAX_DEPTH: u32 = 16;

/// By which tensors are put together; everything else that a pickle can name is refused.
const GLOBALS: [(&str, &str); 2] = [("torch._utils", "_rebuild_tensor_v2"), ("collections", "OrderedDict")];

/// The storages of tensors, in module `torch`.
const STORAGES: [&str; 10] = [
    "ByteStorage",
    "CharStorage",
    "ShortStorage",
    "IntStorage",
    "LongStorage",
    "HalfStorage",
    "BFloat16Storage",
    "FloatStorage",
    "DoubleStorage",
    "BoolStorage",
];

/// What is known of a value.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    /// A number, a truth value, or none.
    Scalar,
    Text,
    /// One of [`GLOBALS`].
    Function,
    Tuple,
    List,
    Dict,
    /// What a function or a storage made.
    Made,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    kind: Kind,
    /// Containers in each other, itself counted.
    depth: u32,
    /// Whether it lies in another one, and has to stay as it is.
    inside: bool,
}

/// Walks through `pickle`.
///
/// # Errors
/// What it asks for that it may not, or what is broken about it.
pub(super) fn check_pickle(pickle: &[u8]) -> Result<(), String> {
    let mut walk = Walk { rest: pickle, nodes: vec![], stack: vec![], marks: vec![], memo: vec![] };
    while walk.instruction()? {}
    Ok(())
}

struct Walk<'a> {
    rest: &'a [u8],
    nodes: Vec<Node>,
    /// Into `nodes`.
    stack: Vec<usize>,
    /// Lengths of the stack.
    marks: Vec<usize>,
    /// Into `nodes`.
    memo: Vec<usize>,
}

impl<'a> Walk<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or("a pickle that was cut off")?;
        self.rest = rest;
        Ok(taken)
    }

    fn number(&mut self, bytes: usize) -> Result<usize, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |number, &byte| number << 8 | usize::from(byte)))
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let end = self.rest.iter().position(|&byte| byte == b'\n').ok_or("a pickle that was cut off")?;
        let line = self.take(end + 1)?;
        std::str::from_utf8(&line[..end]).map_err(|_| "a pickle with a name that is no text".into())
    }

    fn push(&mut self, kind: Kind, depth: u32) -> Result<(), String> {
        if depth > MAX_DEPTH {
            return Err(format!("a pickle with more than {MAX_DEPTH} lists in each other"));
        }
        self.stack.push(self.nodes.len());
        self.nodes.push(Node { kind, depth, inside: false });
        Ok(())
    }

    fn pop(&mut self) -> Result<usize, String> {
        // What lies below a mark belongs to somebody else.
        if self.marks.last().is_some_and(|&mark| self.stack.len() <= mark) {
            return Err("a pickle that takes what isn't there".into());
        }
        self.stack.pop().ok_or("a pickle that takes what isn't there".into())
    }

    /// The values above the last mark.
    fn pop_to_mark(&mut self) -> Result<Vec<usize>, String> {
        let mark = self.marks.pop().ok_or("a pickle without a mark")?;
        Ok(self.stack.split_off(mark))
    }

    fn expect(&self, value: usize, kind: Kind) -> Result<(), String> {
        let found = self.nodes[value].kind;
        if found == kind {
            Ok(())
        } else {
            Err(format!("a pickle with a {found:?} where a {kind:?} belongs"))
        }
    }

    /// One more than the deepest of `values`, which lie in another one from now on.
    fn enclose(&mut self, values: &[usize]) -> u32 {
        for &value in values {
            self.nodes[value].inside = true;
        }
        1 + values.iter().map(|&value| self.nodes[value].depth).max().unwrap_or(0)
    }

    fn tuple(&mut self, values: &[usize]) -> Result<(), String> {
        let depth = self.enclose(values);
        self.push(Kind::Tuple, depth)
    }

    /// Adds `values` to the list or dict on top of the stack. Pickles fill a list before they put it into another one; the
    /// other way round it could become its own part.
    fn extend(&mut self, kind: Kind, values: &[usize]) -> Result<(), String> {
        let container = self.pop()?;
        self.expect(container, kind)?;
        if self.nodes[container].inside || values.contains(&container) {
            return Err("a pickle that changes a list inside another".into());
        }
        if kind == Kind::Dict {
            if !values.len().is_multiple_of(2) {
                return Err("a pickle with a key without a value".into());
            }
            values.iter().step_by(2).try_for_each(|&key| self.expect(key, Kind::Text))?;
        }
        let depth = self.enclose(values).max(self.nodes[container].depth);
        if depth > MAX_DEPTH {
            return Err(format!("a pickle with more than {MAX_DEPTH} lists in each other"));
        }
        self.nodes[container].depth = depth;
        self.stack.push(container);
        Ok(())
    }

    fn remember(&mut self, id: usize) -> Result<(), String> {
        let &top = self.stack.last().ok_or("a pickle that takes what isn't there")?;
        match id.cmp(&self.memo.len()) {
            std::cmp::Ordering::Less => self.memo[id] = top,
            std::cmp::Ordering::Equal => self.memo.push(top),
            std::cmp::Ordering::Greater => {
                return Err(format!("a pickle with memo {id} after {}", self.memo.len()));
            }
        }
        Ok(())
    }

    fn recall(&mut self, id: usize) -> Result<(), String> {
        self.stack.push(
            *self
                .memo
                .get(id)
                .ok_or_else(|| format!("a pickle that recalls memo {id}, which is not there"))?,
        );
        Ok(())
    }

    fn global(&mut self) -> Result<(), String> {
        let (module, name) = (self.line()?, self.line()?);
        match (module, name) {
            known if GLOBALS.contains(&known) => self.push(Kind::Function, 0),
            ("torch", storage) if STORAGES.contains(&storage) => self.push(Kind::Scalar, 0),
            _ => Err(format!("a pickle that asks for {module}.{name}")),
        }
    }

    /// Follows one instruction; false at the end.
    fn instruction(&mut self) -> Result<bool, String> {
        // Named as in Python's pickletools.
        match self.take(1)?[0] {
            // PROTO
            0x80 => match self.number(1)? {
                2 => {}
                other => return Err(format!("a pickle of protocol {other}")),
            },
            // EMPTY_LIST, EMPTY_DICT, EMPTY_TUPLE, MARK
            b']' => self.push(Kind::List, 1)?,
            b'}' => self.push(Kind::Dict, 1)?,
            b')' => self.push(Kind::Tuple, 1)?,
            b'(' => self.marks.push(self.stack.len()),
            // NONE, NEWTRUE, NEWFALSE
            b'N' | 0x88 | 0x89 => self.push(Kind::Scalar, 0)?,
            // BININT1, BININT2, BININT, BINFLOAT
            opcode @ (b'K' | b'M' | b'J' | b'G') => {
                self.take(match opcode {
                    b'K' => 1,
                    b'M' => 2,
                    b'J' => 4,
                    _ => 8,
                })?;
                self.push(Kind::Scalar, 0)?;
            }
            // LONG1, of which libtorch knows numbers of eight bytes
            0x8a => match self.number(1)? {
                8 => {
                    self.take(8)?;
                    self.push(Kind::Scalar, 0)?;
                }
                bytes => return Err(format!("a pickle with a number of {bytes} bytes")),
            },
            // BINUNICODE
            b'X' => {
                let length = self.number(4)?;
                self.take(length)?;
                self.push(Kind::Text, 0)?;
            }
            b'c' => self.global()?,
            // BINPUT, LONG_BINPUT, BINGET, LONG_BINGET
            b'q' => self.number(1).and_then(|id| self.remember(id))?,
            b'r' => self.number(4).and_then(|id| self.remember(id))?,
            b'h' => self.number(1).and_then(|id| self.recall(id))?,
            b'j' => self.number(4).and_then(|id| self.recall(id))?,
            // TUPLE, TUPLE1, TUPLE2, TUPLE3
            b't' => {
                let values = self.pop_to_mark()?;
                self.tuple(&values)?;
            }
            opcode @ 0x85..=0x87 => {
                let values = (0..opcode - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
                self.tuple(&values)?;
            }
            // APPEND, APPENDS, SETITEM, SETITEMS
            b'a' => {
                let value = self.pop()?;
                self.extend(Kind::List, &[value])?;
            }
            b'e' => {
                let values = self.pop_to_mark()?;
                self.extend(Kind::List, &values)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.extend(Kind::Dict, &[key, value])?;
            }
            b'u' => {
                let values = self.pop_to_mark()?;
                self.extend(Kind::Dict, &values)?;
            }
            // REDUCE
            b'R' => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                self.expect(arguments, Kind::Tuple)?;
                self.expect(function, Kind::Function)?;
                self.push(Kind::Made, 0)?;
            }
            // BINPERSID
            b'Q' => {
                let storage = self.pop()?;
                self.expect(storage, Kind::Tuple)?;
                self.push(Kind::Made, 0)?;
            }
            // STOP
            b'.' => {
                return match (self.stack.len(), self.marks.len()) {
                    (1, 0) => Ok(false),
                    (values, _) => Err(format!("a pickle that ends with {values} values")),
                };
            }
            opcode => return Err(format!("a pickle with instruction {opcode:#04x}, which no tensors need")),
        }
        Ok(true)
    }
}
