//! A pickle of tensors, lists, dicts, strings and numbers, as values.
//!
//! A pickle is a program for a small stack machine, and Python's machine calls whatever the program names. This one calls
//! nothing: it knows the instructions that torch.save needs, and the two functions that a tensor is put together by are words
//! to it. Values refer to each other by their numbers, so one that is part of itself does no harm, and each takes a byte of the
//! program at least: what a pickle makes grows with its length, whatever it says.

use tch::Kind;

/// By which tensors are put together; everything else that a pickle can name is refused.
const GLOBALS: [(&str, &str, Value); 12] = [
    ("torch._utils", "_rebuild_tensor_v2", Value::RebuildTensor),
    ("collections", "OrderedDict", Value::OrderedDict),
    ("torch", "ByteStorage", Value::Dtype(Kind::Uint8)),
    ("torch", "CharStorage", Value::Dtype(Kind::Int8)),
    ("torch", "ShortStorage", Value::Dtype(Kind::Int16)),
    ("torch", "IntStorage", Value::Dtype(Kind::Int)),
    ("torch", "LongStorage", Value::Dtype(Kind::Int64)),
    ("torch", "HalfStorage", Value::Dtype(Kind::Half)),
    ("torch", "BFloat16Storage", Value::Dtype(Kind::BFloat16)),
    ("torch", "FloatStorage", Value::Dtype(Kind::Float)),
    ("torch", "DoubleStorage", Value::Dtype(Kind::Double)),
    ("torch", "BoolStorage", Value::Dtype(Kind::Bool)),
];

/// A value's number among [`Values`].
pub(super) type Id = usize;

/// What a pickle makes.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value<'a> {
    /// None, a truth value or a fraction: no field has one.
    Constant,
    Integer(i64),
    Text(&'a str),
    /// The function that makes a tensor.
    RebuildTensor,
    /// The type of a tensor's hooks.
    OrderedDict,
    /// The type of a storage: what its numbers are.
    Dtype(Kind),
    /// Bytes in the archive. On which device they were when they were saved doesn't matter.
    Storage {
        dtype: Kind,
        key: &'a str,
    },
    /// A view of a storage, in its elements.
    Tensor {
        storage: Id,
        offset: Id,
        size: Id,
        stride: Id,
    },
    /// Of a tensor.
    Hooks,
    Tuple(Vec<Id>),
    List(Vec<Id>),
    /// Keys and values by turns; of equal keys the last one counts.
    Dict(Vec<Id>),
}

impl Value<'_> {
    /// As errors call it.
    pub fn name(&self) -> &'static str {
        match self {
            Value::Constant => "a constant",
            Value::Integer(_) => "an integer",
            Value::Text(_) => "a string",
            Value::RebuildTensor | Value::OrderedDict => "a function",
            Value::Dtype(_) => "a type",
            Value::Storage { .. } => "a storage",
            Value::Tensor { .. } => "a tensor",
            Value::Hooks => "a tensor's hooks",
            Value::Tuple(_) => "a tuple",
            Value::List(_) => "a list",
            Value::Dict(_) => "a dict",
        }
    }
}

/// Everything that a pickle made.
#[derive(Debug)]
pub(super) struct Values<'a> {
    values: Vec<Value<'a>>,
    /// What it was made for.
    pub root: Id,
}

impl<'a> Values<'a> {
    /// Value number `id`.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id]
    }
}

/// Follows `pickle`.
///
/// # Errors
/// What it asks for that it may not, or what is broken about it.
pub(super) fn unpickle(pickle: &[u8]) -> Result<Values<'_>, String> {
    let mut machine = Machine { rest: pickle, values: vec![], stack: vec![], marks: vec![], memo: vec![] };
    loop {
        if let Some(root) = machine.instruction()? {
            return Ok(Values { values: machine.values, root });
        }
    }
}

struct Machine<'a> {
    rest: &'a [u8],
    values: Vec<Value<'a>>,
    stack: Vec<Id>,
    /// Lengths of the stack.
    marks: Vec<usize>,
    memo: Vec<Id>,
}

impl<'a> Machine<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or("a pickle that was cut off")?;
        self.rest = rest;
        Ok(taken)
    }

    /// Little-endian.
    fn unsigned(&mut self, bytes: usize) -> Result<usize, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |number, &byte| number << 8 | usize::from(byte)))
    }

    /// Little-endian, in two's complement, of up to eight bytes.
    fn signed(&mut self, bytes: usize) -> Result<Value<'a>, String> {
        let taken = self.take(bytes)?;
        let mut wide = [if taken.last().is_some_and(|&byte| byte >= 0x80) { 0xff } else { 0 }; 8];
        wide[..bytes].copy_from_slice(taken);
        Ok(Value::Integer(i64::from_le_bytes(wide)))
    }

    fn text(&mut self, bytes: usize) -> Result<&'a str, String> {
        std::str::from_utf8(self.take(bytes)?).map_err(|_| "a pickle with a string that is no UTF-8".into())
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let end = self.rest.iter().position(|&byte| byte == b'\n').ok_or("a pickle that was cut off")?;
        let line = self.text(end)?;
        self.take(1)?;
        Ok(line)
    }

    fn push(&mut self, value: Value<'a>) {
        self.stack.push(self.values.len());
        self.values.push(value);
    }

    fn pop(&mut self) -> Result<Id, String> {
        // What lies below a mark belongs to somebody else.
        if self.marks.last().is_some_and(|&mark| self.stack.len() <= mark) {
            return Err("a pickle that takes what isn't there".into());
        }
        self.stack.pop().ok_or("a pickle that takes what isn't there".into())
    }

    /// The values above the last mark.
    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("a pickle without a mark")?;
        Ok(self.stack.split_off(mark))
    }

    /// Adds `values` to the list on top of the stack.
    fn append(&mut self, values: &[Id]) -> Result<(), String> {
        let list = self.pop()?;
        match &mut self.values[list] {
            Value::List(items) => items.extend_from_slice(values),
            other => return Err(format!("a pickle that appends to {}", other.name())),
        }
        self.stack.push(list);
        Ok(())
    }

    /// Adds `values`, keys and values by turns, to the dict on top of the stack.
    fn set_items(&mut self, values: &[Id]) -> Result<(), String> {
        if !values.len().is_multiple_of(2) {
            return Err("a pickle with a key without a value".into());
        }
        let strange = values.iter().step_by(2).find(|&&key| !matches!(self.values[key], Value::Text(_)));
        if let Some(&key) = strange {
            return Err(format!(
                "a pickle with {} as a key, where a string belongs",
                self.values[key].name()
            ));
        }
        let dict = self.pop()?;
        match &mut self.values[dict] {
            Value::Dict(items) => items.extend_from_slice(values),
            other => return Err(format!("a pickle that sets items of {}", other.name())),
        }
        self.stack.push(dict);
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
        let value =
            self.memo.get(id).ok_or_else(|| format!("a pickle that recalls memo {id}, which is not there"));
        self.stack.push(*value?);
        Ok(())
    }

    fn global(&mut self) -> Result<(), String> {
        let (module, name) = (self.line()?, self.line()?);
        let known = GLOBALS.into_iter().find(|(m, n, _)| (*m, *n) == (module, name));
        let (.., value) = known.ok_or_else(|| format!("a pickle that asks for {module}.{name}"))?;
        self.push(value);
        Ok(())
    }

    fn tuple(&self, id: Id) -> &[Id] {
        match &self.values[id] {
            Value::Tuple(items) => items,
            _ => &[],
        }
    }

    /// What a persistent id stands for: ("storage", its type, its key, the device, the number of its elements).
    fn storage(&self, id: Id) -> Result<Value<'a>, String> {
        let strange = || "a pickle with a persistent id that is no storage".to_string();
        let &[tag, dtype, key, device, length] = self.tuple(id) else { return Err(strange()) };
        let of = |id: Id| &self.values[id];
        match (of(tag), of(dtype), of(key), of(device), of(length)) {
            (
                Value::Text("storage"),
                &Value::Dtype(dtype),
                Value::Text(key),
                Value::Text(_),
                Value::Integer(_),
            ) => Ok(Value::Storage { dtype, key }),
            _ => Err(strange()),
        }
    }

    /// What `function` makes of the tuple `arguments`.
    fn call(&self, function: Id, arguments: Id) -> Result<Value<'a>, String> {
        let is = |id: Id, what: fn(&Value) -> bool| what(&self.values[id]);
        match (&self.values[function], self.tuple(arguments)) {
            (Value::OrderedDict, []) => Ok(Value::Hooks),
            // Behind these come whether it needs a gradient, its hooks, and maybe more.
            (Value::RebuildTensor, &[storage, offset, size, stride, ..])
                if is(storage, |v| matches!(v, Value::Storage { .. }))
                    && is(offset, |v| matches!(v, Value::Integer(_)))
                    && is(size, |v| matches!(v, Value::Tuple(_)))
                    && is(stride, |v| matches!(v, Value::Tuple(_))) =>
            {
                Ok(Value::Tensor { storage, offset, size, stride })
            }
            (Value::RebuildTensor, _) => {
                Err("a pickle with a tensor of other than storage, offset, size and stride".into())
            }
            (other, _) => Err(format!("a pickle that calls {}", other.name())),
        }
    }

    /// Follows one instruction; what the pickle was made for at its end.
    fn instruction(&mut self) -> Result<Option<Id>, String> {
        // Named as in Python's pickletools.
        match self.take(1)?[0] {
            // PROTO
            0x80 => match self.unsigned(1)? {
                2 => {}
                other => return Err(format!("a pickle of protocol {other}")),
            },
            // EMPTY_LIST, EMPTY_DICT, EMPTY_TUPLE, MARK
            b']' => self.push(Value::List(vec![])),
            b'}' => self.push(Value::Dict(vec![])),
            b')' => self.push(Value::Tuple(vec![])),
            b'(' => self.marks.push(self.stack.len()),
            // NONE, NEWTRUE, NEWFALSE
            b'N' | 0x88 | 0x89 => self.push(Value::Constant),
            // BININT1, BININT2, BININT
            opcode @ (b'K' | b'M') => {
                let number = self.unsigned(if opcode == b'K' { 1 } else { 2 })?;
                self.push(Value::Integer(number as i64));
            }
            b'J' => {
                let number = self.signed(4)?;
                self.push(number);
            }
            // LONG1
            0x8a => match self.unsigned(1)? {
                bytes @ 0..=8 => {
                    let number = self.signed(bytes)?;
                    self.push(number);
                }
                bytes => return Err(format!("a pickle with a number of {bytes} bytes")),
            },
            // BINFLOAT
            b'G' => {
                self.take(8)?;
                self.push(Value::Constant);
            }
            // BINUNICODE
            b'X' => {
                let length = self.unsigned(4)?;
                let text = self.text(length)?;
                self.push(Value::Text(text));
            }
            // GLOBAL
            b'c' => self.global()?,
            // BINPUT, LONG_BINPUT, BINGET, LONG_BINGET
            b'q' => self.unsigned(1).and_then(|id| self.remember(id))?,
            b'r' => self.unsigned(4).and_then(|id| self.remember(id))?,
            b'h' => self.unsigned(1).and_then(|id| self.recall(id))?,
            b'j' => self.unsigned(4).and_then(|id| self.recall(id))?,
            // TUPLE, TUPLE1, TUPLE2, TUPLE3
            b't' => {
                let values = self.pop_to_mark()?;
                self.push(Value::Tuple(values));
            }
            opcode @ 0x85..=0x87 => {
                let mut values = (0..opcode - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
                values.reverse();
                self.push(Value::Tuple(values));
            }
            // APPEND, APPENDS, SETITEM, SETITEMS
            b'a' => {
                let value = self.pop()?;
                self.append(&[value])?;
            }
            b'e' => {
                let values = self.pop_to_mark()?;
                self.append(&values)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set_items(&[key, value])?;
            }
            b'u' => {
                let values = self.pop_to_mark()?;
                self.set_items(&values)?;
            }
            // REDUCE
            b'R' => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                let made = self.call(function, arguments)?;
                self.push(made);
            }
            // BINPERSID
            b'Q' => {
                let id = self.pop()?;
                let storage = self.storage(id)?;
                self.push(storage);
            }
            // STOP
            b'.' => {
                return match (self.stack.as_slice(), self.marks.len()) {
                    (&[root], 0) => Ok(Some(root)),
                    (values, _) => Err(format!("a pickle that ends with {} values", values.len())),
                };
            }
            opcode => return Err(format!("a pickle with instruction {opcode:#04x}, which no tensors need")),
        }
        Ok(None)
    }
}
