//! Interpreter for pickles of tensors, lists, dicts, strings and numbers.
//!
//! A pickle is a program for a small stack machine, and Python's machine calls whatever the program names. This one calls nothing: it knows
//! the instructions that torch.save needs, and treats the functions that assemble data as names. Values refer to each other by index, so a
//! value that contains itself is harmless. Each value takes at least one byte of the program, so the size of the result is proportional to
//! the length of the pickle, whatever it contains.

use crate::globals::{find_tensor_global, is_plain_constructor};
use crate::value::{Id, Rebuild, Value, Values};

/// Treatment of values that aren't tensors, lists, dicts, strings or numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnknownGlobals {
    /// Returns an error for such values. This is for files that don't need them.
    Refuse,
    /// Keeps such values as data of an unknown type. A pickle that would make Python call a function is still refused, unless the function
    /// is known to only assemble data.
    Keep,
}

/// Executes the pickle at the start of `rest`, of protocol 2 to 5, and leaves in `rest` the bytes after it. Nothing is called: see
/// [`UnknownGlobals`].
///
/// # Errors
/// Returns a description of what the pickle requests but may not, or of what is broken in it.
pub fn unpickle<'a>(rest: &mut &'a [u8], unknown_globals: UnknownGlobals) -> Result<Values<'a>, String> {
    let (values, stack, marks, memo) = (vec![], vec![], vec![], vec![]);
    let mut machine = Machine { rest, unknown_globals, values, stack, marks, memo };
    loop {
        if let Some(root) = machine.instruction()? {
            *rest = machine.rest;
            return Ok(Values { values: machine.values, root });
        }
    }
}

struct Machine<'a> {
    rest: &'a [u8],
    unknown_globals: UnknownGlobals,
    values: Vec<Value<'a>>,
    stack: Vec<Id>,
    /// Lengths of the stack at the marks.
    marks: Vec<usize>,
    memo: Vec<Id>,
}

impl<'a> Machine<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or("a pickle that was cut off")?;
        self.rest = rest;
        Ok(taken)
    }

    /// Reads an unsigned little-endian number of `bytes` bytes.
    fn unsigned(&mut self, bytes: usize) -> Result<usize, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |number, &byte| number << 8 | usize::from(byte)))
    }

    /// Reads a little-endian number of up to eight bytes, in two's complement.
    fn signed(&mut self, bytes: usize) -> Result<Value<'a>, String> {
        let taken = self.take(bytes)?;
        let mut wide = [if taken.last().is_some_and(|&byte| byte >= 0x80) { 0xff } else { 0 }; 8];
        wide[..bytes].copy_from_slice(taken);
        Ok(Value::Int(i64::from_le_bytes(wide)))
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
        // An instruction may not pop values below the last mark.
        if self.marks.last().is_some_and(|&mark| self.stack.len() <= mark) {
            return Err("a pickle that pops from an empty stack".into());
        }
        self.stack.pop().ok_or("a pickle that pops from an empty stack".into())
    }

    /// Pops the values above the last mark.
    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("a pickle without a mark")?;
        Ok(self.stack.split_off(mark))
    }

    /// Appends `values` to the list on top of the stack.
    fn append(&mut self, values: &[Id]) -> Result<(), String> {
        let list = self.pop()?;
        match &mut self.values[list] {
            Value::List(items) => items.extend_from_slice(values),
            // An instance of a subclass of list, or a set.
            Value::Object(_) => {}
            other => return Err(format!("a pickle that appends to {}", other.type_name())),
        }
        self.stack.push(list);
        Ok(())
    }

    /// Adds `values`, alternating keys and values, to the dict on top of the stack.
    fn set_items(&mut self, values: &[Id]) -> Result<(), String> {
        let (pairs, rest) = values.as_chunks();
        if !rest.is_empty() {
            return Err("a pickle with a key without a value".into());
        }
        let dict = self.pop()?;
        match &mut self.values[dict] {
            Value::Dict(items) | Value::Object(items) => {
                items.extend(pairs.iter().map(|&[key, value]| (key, value)));
            }
            other => return Err(format!("a pickle that sets items of {}", other.type_name())),
        }
        self.stack.push(dict);
        Ok(())
    }

    fn memoize(&mut self, id: usize) -> Result<(), String> {
        let &top = self.stack.last().ok_or("a pickle that pops from an empty stack")?;
        match id.cmp(&self.memo.len()) {
            std::cmp::Ordering::Less => self.memo[id] = top,
            std::cmp::Ordering::Equal => self.memo.push(top),
            std::cmp::Ordering::Greater => {
                return Err(format!("a pickle with memo {id} after {}", self.memo.len()));
            }
        }
        Ok(())
    }

    fn push_memo(&mut self, id: usize) -> Result<(), String> {
        let value =
            self.memo.get(id).ok_or_else(|| format!("a pickle that recalls memo {id}, which is missing"));
        self.stack.push(*value?);
        Ok(())
    }

    /// Pushes the value of a global name: a known one, or with [`UnknownGlobals::Keep`] one that has just its name.
    fn global(&mut self, module: &'a str, name: &'a str) -> Result<(), String> {
        let value = match (find_tensor_global(module, name), self.unknown_globals) {
            (Some(value), _) => value,
            (None, UnknownGlobals::Keep) => Value::Global { module, name },
            (None, UnknownGlobals::Refuse) => return Err(format!("a pickle that asks for {module}.{name}")),
        };
        self.push(value);
        Ok(())
    }

    fn tuple(&self, id: Id) -> &[Id] {
        match &self.values[id] {
            Value::Tuple(items) => items,
            _ => &[],
        }
    }

    /// Returns the storage of a persistent id: ("storage", its type, its key, the device, its number of elements). Files that are no
    /// archives have one more item, the storage that this one is a part of, which must be None.
    fn storage(&self, id: Id) -> Result<Value<'a>, String> {
        let unsupported = || "a pickle with a persistent id that is no storage".to_string();
        let of = |id: &Id| &self.values[*id];
        let (fields, whole) = match self.tuple(id) {
            [fields @ .., whole] if fields.len() == 5 && self.unknown_globals == UnknownGlobals::Keep => {
                (fields, of(whole) == &Value::None)
            }
            fields => (fields, true),
        };
        let [tag, dtype, key, device, length] = fields else { return Err(unsupported()) };
        match (of(tag), of(dtype), of(key), of(device), of(length)) {
            (Value::Str("storage"), &Value::Dtype(dtype), Value::Str(key), Value::Str(_), Value::Int(_))
                if whole =>
            {
                Ok(Value::Storage { dtype, key })
            }
            _ => Err(unsupported()),
        }
    }

    /// Returns the result of `function` for the tuple `arguments`.
    fn call(&self, function: Id, arguments: Id) -> Result<Value<'a>, String> {
        let is = |id: Id, what: fn(&Value) -> bool| what(&self.values[id]);
        let is_object = |id: Id| is(id, |v| matches!(v, Value::Object(_)));
        match (&self.values[function], self.tuple(arguments)) {
            (Value::OrderedDict, []) => Ok(Value::Dict(vec![])),
            (Value::Rebuild(Rebuild::Tensor), &[storage, offset, size, stride, ..])
                if is(storage, |v| matches!(v, Value::Storage { .. }))
                    && is(offset, |v| matches!(v, Value::Int(_)))
                    && is(size, |v| matches!(v, Value::Tuple(_)))
                    && is(stride, |v| matches!(v, Value::Tuple(_))) =>
            {
                Ok(Value::Tensor { storage, offset, size, stride })
            }
            (Value::Rebuild(Rebuild::Parameter), &[data, ..])
                if is(data, |v| matches!(v, Value::Tensor { .. })) =>
            {
                Ok(self.values[data].clone())
            }
            (Value::Rebuild(Rebuild::FromType), &[function, _class, arguments, ..]) => {
                match &self.values[function] {
                    Value::Rebuild(Rebuild::Tensor | Rebuild::Parameter) => self.call(function, arguments),
                    _ => Ok(Value::Object(vec![])),
                }
            }
            (Value::Rebuild(_), &[data, ..]) if is_object(data) => Ok(Value::Object(vec![])),
            (Value::Rebuild(_), _) => {
                Err("a pickle with a tensor of other than storage, offset, size and stride".into())
            }
            (&Value::Global { module, name }, _) => match is_plain_constructor(module, name) {
                true => Ok(Value::Object(vec![])),
                false => Err(format!("a pickle that calls {module}.{name}")),
            },
            (other, _) => Err(format!("a pickle that calls {}", other.type_name())),
        }
    }

    /// Pushes an instance of `class`, which Python creates by `__new__` alone.
    fn instance(&mut self, class: Id) -> Result<(), String> {
        let made = match &self.values[class] {
            Value::Global { .. } => Value::Object(vec![]),
            Value::OrderedDict => Value::Dict(vec![]),
            other => return Err(format!("a pickle with an instance of {}", other.type_name())),
        };
        self.push(made);
        Ok(())
    }

    /// Executes one instruction. At the end of the pickle, returns the index of its result.
    fn instruction(&mut self) -> Result<Option<Id>, String> {
        // Instructions are named as in Python's pickletools.
        match self.take(1)?[0] {
            // PROTO
            0x80 => match self.unsigned(1)? {
                2..=5 => {}
                other => return Err(format!("a pickle of protocol {other}")),
            },
            // FRAME: ignored, because instructions are read one by one anyway.
            0x95 => {
                self.take(8)?;
            }
            // EMPTY_LIST, EMPTY_DICT, EMPTY_TUPLE, EMPTY_SET, MARK
            b']' => self.push(Value::List(vec![])),
            b'}' => self.push(Value::Dict(vec![])),
            b')' => self.push(Value::Tuple(vec![])),
            0x8f => self.push(Value::Object(vec![])),
            b'(' => self.marks.push(self.stack.len()),
            // POP, POP_MARK, DUP
            b'0' => {
                self.pop()?;
            }
            b'1' => {
                self.pop_to_mark()?;
            }
            b'2' => {
                let top = self.pop()?;
                self.stack.extend([top, top]);
            }
            // NONE, NEWTRUE, NEWFALSE
            b'N' => self.push(Value::None),
            opcode @ (0x88 | 0x89) => self.push(Value::Bool(opcode == 0x88)),
            // BININT1, BININT2, BININT
            opcode @ (b'K' | b'M') => {
                let number = self.unsigned(if opcode == b'K' { 1 } else { 2 })?;
                self.push(Value::Int(number as i64));
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
                bytes => {
                    self.take(bytes)?;
                    self.push(Value::LargeInt);
                }
            },
            // BINFLOAT
            b'G' => {
                let bytes = self.take(8)?.try_into().expect("eight bytes");
                self.push(Value::Float(f64::from_be_bytes(bytes)));
            }
            // SHORT_BINUNICODE, BINUNICODE, BINUNICODE8
            opcode @ (0x8c | b'X' | 0x8d) => {
                let length = self.unsigned(length_bytes(opcode))?;
                let text = self.text(length)?;
                self.push(Value::Str(text));
            }
            // SHORT_BINBYTES, BINBYTES, BINBYTES8, BYTEARRAY8
            opcode @ (b'C' | b'B' | 0x8e | 0x96) => {
                let length = self.unsigned(length_bytes(opcode))?;
                self.take(length)?;
                self.push(Value::Object(vec![]));
            }
            // GLOBAL
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.global(module, name)?;
            }
            // STACK_GLOBAL
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (&Value::Str(module), &Value::Str(name)) = (&self.values[module], &self.values[name])
                else {
                    return Err("a pickle with a name that is no string".into());
                };
                self.global(module, name)?;
            }
            // BINPUT, LONG_BINPUT, BINGET, LONG_BINGET
            b'q' => self.unsigned(1).and_then(|id| self.memoize(id))?,
            b'r' => self.unsigned(4).and_then(|id| self.memoize(id))?,
            b'h' => self.unsigned(1).and_then(|id| self.push_memo(id))?,
            b'j' => self.unsigned(4).and_then(|id| self.push_memo(id))?,
            // MEMOIZE
            0x94 => self.memoize(self.memo.len())?,
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
            // FROZENSET
            0x91 => {
                self.pop_to_mark()?;
                self.push(Value::Object(vec![]));
            }
            // APPEND; APPENDS, ADDITEMS; SETITEM; SETITEMS
            b'a' => {
                let value = self.pop()?;
                self.append(&[value])?;
            }
            b'e' | 0x90 => {
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
            // NEWOBJ, NEWOBJ_EX
            opcode @ (0x81 | 0x92) => {
                if opcode == 0x92 {
                    self.pop()?;
                }
                let (_arguments, class) = (self.pop()?, self.pop()?);
                self.instance(class)?;
            }
            // BUILD, which sets the fields of an object
            b'b' => {
                self.pop()?;
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

/// Returns the number of bytes of the length that precedes a string or bytes.
fn length_bytes(opcode: u8) -> usize {
    match opcode {
        0x8c | b'C' => 1,
        b'X' | b'B' => 4,
        _ => 8,
    }
}
