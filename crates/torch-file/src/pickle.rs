//! Interpreter for pickles of tensors, lists, dicts, strings and numbers.
//!
//! A pickle is a program for a small stack machine, and Python's machine calls whatever the program names. This one calls nothing: it knows
//! the instructions that torch.save needs, and treats the functions that assemble data as names. Values refer to each other by index, so a
//! value that contains itself is harmless. Each value takes at least one byte of the program, so the size of the result is proportional to
//! the length of the pickle, whatever it contains.

use safetensors::Dtype;

/// Index of a value in [`Values`].
pub type Id = usize;

/// A value that a pickle creates. It refers to others by their index in [`Values`].
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Value<'a> {
    /// None.
    None,
    /// Boolean.
    Bool(bool),
    /// Integer of up to 64 bits.
    Int(i64),
    /// Floating-point number.
    Float(f64),
    /// String.
    Str(&'a str),
    /// Class or function.
    Global {
        /// Module that defines it.
        module: &'a str,
        /// Name in the module.
        name: &'a str,
    },
    /// Storage: bytes in the file. The device on which they were when they were saved is ignored.
    Storage {
        /// Type of the elements.
        dtype: Dtype,
        /// Key of the storage in [`Storages`](crate::Storages).
        key: &'a str,
    },
    /// Tensor: view of a storage, in elements of the storage. [`Array::locate`](crate::Array::locate) checks it.
    Tensor {
        /// A [`Value::Storage`].
        storage: Id,
        /// First element, a [`Value::Int`].
        offset: Id,
        /// Size of each dimension, a [`Value::Tuple`].
        size: Id,
        /// Stride of each dimension, a [`Value::Tuple`].
        stride: Id,
    },
    /// Tuple.
    Tuple(Vec<Id>),
    /// List.
    List(Vec<Id>),
    /// Dict or OrderedDict: keys and values. The last of equal keys counts.
    Dict(Vec<(Id, Id)>),
    /// Set, bytes, integer of more than 64 bits, or data of an unknown class. If it is also a dict: keys and values.
    Object(Vec<(Id, Id)>),
}

impl Value<'_> {
    /// Returns the name of the value's type for error messages, as in "a dict".
    pub fn type_name(&self) -> &'static str {
        match self {
            Value::None | Value::Bool(_) | Value::Float(_) => "a constant",
            Value::Int(_) => "an integer",
            Value::Str(_) => "a string",
            Value::Global { .. } => "a class or a function",
            Value::Storage { .. } => "a storage",
            Value::Tensor { .. } => "a tensor",
            Value::Tuple(_) => "a tuple",
            Value::List(_) => "a list",
            Value::Dict(_) => "a dict",
            Value::Object(_) => "an object",
        }
    }

    /// Returns the number if the value is an integer of up to 64 bits.
    pub fn as_int(&self) -> Option<i64> {
        match self {
            &Value::Int(number) => Some(number),
            _ => None,
        }
    }
}

/// All values that a pickle created.
#[derive(Debug)]
pub struct Values<'a> {
    values: Vec<Value<'a>>,
    /// Index of the pickle's result.
    pub root: Id,
}

impl<'a> Values<'a> {
    /// Returns the value with index `id`, which another of these values refers to.
    ///
    /// # Panics
    /// Panics if `id` is an index of other values, and too large for these.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id]
    }

    /// Returns an iterator over all values, in the order in which the pickle creates them.
    pub fn iter(&self) -> impl Iterator<Item = &Value<'a>> {
        self.values.iter()
    }

    /// Returns the value under the string `key` in `items`, the keys and values of a dict.
    pub fn find(&self, items: &[(Id, Id)], key: &str) -> Option<&Value<'a>> {
        let entry = items.iter().rev().find(|(id, _)| self.values[*id] == Value::Str(key));
        entry.map(|(_, value)| &self.values[*value])
    }
}

/// Classes of the module `torch` for storages, by the type of their elements.
pub(crate) const STORAGES: [(Dtype, &str); 11] = [
    (Dtype::U8, "ByteStorage"),
    (Dtype::I8, "CharStorage"),
    (Dtype::I16, "ShortStorage"),
    (Dtype::I32, "IntStorage"),
    (Dtype::I64, "LongStorage"),
    (Dtype::F16, "HalfStorage"),
    (Dtype::BF16, "BFloat16Storage"),
    (Dtype::F32, "FloatStorage"),
    (Dtype::F64, "DoubleStorage"),
    (Dtype::BOOL, "BoolStorage"),
    (Dtype::C64, "ComplexFloatStorage"),
];

/// Functions and classes that only assemble data when Python calls them: the parts of settings, optimizers and training states. Modules,
/// and names in them.
const DATA_CONSTRUCTORS: [(&str, &str); 14] = [
    (
        "builtins __builtin__",
        "bool bytearray bytes complex dict float frozenset int list long object range set slice str tuple",
    ),
    ("_codecs", "encode"),
    ("argparse", "Namespace"),
    ("collections", "Counter OrderedDict defaultdict deque"),
    ("copyreg copy_reg", "_reconstructor"),
    ("datetime", "date datetime time timedelta timezone"),
    ("functools", "partial"),
    ("numpy", "dtype ndarray"),
    ("numpy._core.multiarray numpy.core.multiarray", "_reconstruct scalar"),
    ("numpy._core.numeric numpy.core.numeric", "_frombuffer"),
    ("pathlib pathlib._local", "Path PosixPath PurePosixPath PureWindowsPath WindowsPath"),
    ("torch", "Size device"),
    ("torch._utils", "_rebuild_qtensor _rebuild_sparse_tensor _rebuild_tensor_v3"),
    ("torch.serialization", "_get_layout"),
];
/// Packages whose classes, recognized by their initial capital letter, hold settings and training states.
const DATA_PACKAGES: [&str; 6] =
    ["lightning", "lightning_fabric", "omegaconf", "pytorch_lightning", "torchmetrics", "yacs"];

/// Returns `true` if a call of this function or class does nothing but assemble data.
fn is_plain_constructor(module: &str, name: &str) -> bool {
    let has = |words: &str, word: &str| words.split(' ').any(|listed| listed == word);
    let package = module.split('.').next().unwrap_or_default();
    let is_class = name.starts_with(|first: char| first.is_ascii_uppercase()) && !name.contains('.');
    DATA_CONSTRUCTORS.iter().any(|(modules, names)| has(modules, module) && has(names, name))
        || (is_class && DATA_PACKAGES.contains(&package))
}

/// Executes the pickle at the start of `bytes`, of protocol 2 to 5. Values that aren't tensors, lists, dicts, strings or numbers are kept as
/// data of an unknown type. Nothing is called, and a pickle that would make Python call a function is refused, unless the function is known
/// to only assemble data.
///
/// # Errors
/// Returns a description of what the pickle requests but may not, or of what is broken in it.
pub(crate) fn unpickle(bytes: &[u8]) -> Result<Values<'_>, String> {
    let (values, stack, marks, memo) = (vec![], vec![], vec![], vec![]);
    let mut machine = Machine { rest: bytes, values, stack, marks, memo };
    loop {
        if let Some(root) = machine.instruction()? {
            return Ok(Values { values: machine.values, root });
        }
    }
}

/// Message about a call that creates a tensor of other arguments than it has.
const NO_TENSOR: &str = "a pickle with a tensor of other than storage, offset, size and stride";

struct Machine<'a> {
    rest: &'a [u8],
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

    /// Reads a little-endian number in two's complement, which is kept if it has at most eight bytes.
    fn signed(&mut self, bytes: usize) -> Result<Value<'a>, String> {
        let taken = self.take(bytes)?;
        let mut wide = [if taken.last().is_some_and(|&byte| byte >= 0x80) { 0xff } else { 0 }; 8];
        let Some(low) = wide.get_mut(..bytes) else { return Ok(Value::Object(vec![])) };
        low.copy_from_slice(taken);
        Ok(Value::Int(i64::from_le_bytes(wide)))
    }

    /// Reads the length in the argument of `opcode`, and as many bytes.
    fn counted(&mut self, opcode: u8) -> Result<&'a [u8], String> {
        let length = match opcode {
            0x8c | b'C' => self.unsigned(1)?,
            b'X' | b'B' => self.unsigned(4)?,
            _ => self.unsigned(8)?,
        };
        self.take(length)
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let end = self.rest.iter().position(|&byte| byte == b'\n').ok_or("a pickle that was cut off")?;
        let line = text(self.take(end)?)?;
        self.take(1)?;
        Ok(line)
    }

    fn pop(&mut self) -> Result<Id, String> {
        // An instruction may not pop values below the last mark.
        let is_empty = self.marks.last().is_some_and(|&mark| self.stack.len() <= mark);
        self.stack.pop().filter(|_| !is_empty).ok_or("a pickle that pops from an empty stack".into())
    }

    /// Pops the values above the last mark.
    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("a pickle without a mark")?;
        Ok(self.stack.split_off(mark))
    }

    /// Appends `values` to the list on top of the stack.
    fn append(&mut self, values: &[Id]) -> Result<(), String> {
        let list = self.pop()?;
        self.stack.push(list);
        match &mut self.values[list] {
            Value::List(items) => items.extend_from_slice(values),
            // An instance of a subclass of list, or a set.
            Value::Object(_) => {}
            other => return Err(format!("a pickle that appends to {}", other.type_name())),
        }
        Ok(())
    }

    /// Adds `values`, alternating keys and values, to the dict on top of the stack.
    fn set_items(&mut self, values: &[Id]) -> Result<(), String> {
        let (pairs, []) = values.as_chunks() else {
            return Err("a pickle with a key without a value".into());
        };
        let dict = self.pop()?;
        self.stack.push(dict);
        match &mut self.values[dict] {
            Value::Dict(items) | Value::Object(items) => items.extend(pairs.iter().map(|&[k, v]| (k, v))),
            other => return Err(format!("a pickle that sets items of {}", other.type_name())),
        }
        Ok(())
    }

    fn memoize(&mut self, id: usize) -> Result<(), String> {
        let &top = self.stack.last().ok_or("a pickle that pops from an empty stack")?;
        if id > self.memo.len() {
            return Err(format!("a pickle with memo {id} after {}", self.memo.len()));
        }
        self.memo.splice(id..(id + 1).min(self.memo.len()), [top]);
        Ok(())
    }

    fn push_memo(&mut self, id: usize) -> Result<(), String> {
        let value = self.memo.get(id);
        self.stack.push(*value.ok_or_else(|| format!("a pickle that recalls memo {id}, which is missing"))?);
        Ok(())
    }

    fn tuple(&self, id: Id) -> &[Id] {
        match &self.values[id] {
            Value::Tuple(items) => items,
            _ => &[],
        }
    }

    /// Returns the module and the name of a class or function that is used for `what`.
    fn global(&self, id: Id, what: &str) -> Result<(&'a str, &'a str), String> {
        match &self.values[id] {
            Value::Global { module, name } => Ok((module, name)),
            other => Err(format!("a pickle {what} {}", other.type_name())),
        }
    }

    /// Returns the storage of a persistent id: ("storage", its type, its key, the device, its number of elements).
    fn storage(&self, id: Id) -> Result<Value<'a>, String> {
        let parts: Vec<&Value> = self.tuple(id).iter().map(|&part| &self.values[part]).collect();
        let &[
            Value::Str("storage"),
            &Value::Global { module, name },
            &Value::Str(key),
            Value::Str(_),
            Value::Int(_),
        ] = &parts[..]
        else {
            return Err("a pickle with a persistent id that is no storage".into());
        };
        let stored = STORAGES.iter().find(|(_, class)| module == "torch" && *class == name);
        Ok(match (stored, name) {
            (Some(&(dtype, _)), _) => Value::Storage { dtype, key },
            (None, "UntypedStorage") => Value::Storage { dtype: Dtype::U8, key },
            // Quantized numbers, for example.
            _ => Value::Object(vec![]),
        })
    }

    /// Returns the result of `function` for the tuple `arguments`. More arguments than those that are used may follow, such as
    /// `requires_grad` and hooks.
    fn call(&self, function: Id, arguments: Id) -> Result<Value<'a>, String> {
        let (mut module, mut name) = self.global(function, "that calls")?;
        let mut arguments = self.tuple(arguments);
        // A function that creates a tensor, a class, the arguments of the function, and attributes.
        if let ("torch._tensor", "_rebuild_from_type_v2", &[inner, _class, inner_arguments, ..]) =
            (module, name, arguments)
        {
            (module, name) = self.global(inner, "that calls")?;
            arguments = self.tuple(inner_arguments);
        }
        let of = |id: Id| &self.values[id];
        Ok(match (module, name, arguments) {
            ("collections", "OrderedDict", []) => Value::Dict(vec![]),
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2", arguments) => {
                let &[storage, offset, size, stride, ..] = arguments else { return Err(NO_TENSOR.into()) };
                match (of(storage), of(offset), of(size), of(stride)) {
                    (Value::Storage { .. }, Value::Int(_), Value::Tuple(_), Value::Tuple(_)) => {
                        Value::Tensor { storage, offset, size, stride }
                    }
                    (Value::Object(_), ..) => Value::Object(vec![]),
                    _ => return Err(NO_TENSOR.into()),
                }
            }
            ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state", &[data, ..]) => {
                match of(data) {
                    tensor @ (Value::Tensor { .. } | Value::Object(_)) => tensor.clone(),
                    _ => return Err(NO_TENSOR.into()),
                }
            }
            _ if is_plain_constructor(module, name) => Value::Object(vec![]),
            _ => return Err(format!("a pickle that calls {module}.{name}")),
        })
    }

    /// Executes one instruction. At the end of the pickle, returns the index of its result.
    fn instruction(&mut self) -> Result<Option<Id>, String> {
        // Instructions are named as in Python's pickletools. First those that don't push a new value.
        let opcode = self.take(1)?[0];
        match opcode {
            // PROTO
            0x80 => match self.unsigned(1)? {
                2..=5 => {}
                other => return Err(format!("a pickle of protocol {other}")),
            },
            // FRAME: ignored, because instructions are read one by one anyway.
            0x95 => drop(self.take(8)?),
            // MARK, POP, POP_MARK, DUP
            b'(' => self.marks.push(self.stack.len()),
            b'0' => drop(self.pop()?),
            b'1' => drop(self.pop_to_mark()?),
            b'2' => {
                let top = self.pop()?;
                self.stack.extend([top, top]);
            }
            // BINPUT, LONG_BINPUT, MEMOIZE, BINGET, LONG_BINGET
            b'q' => self.unsigned(1).and_then(|id| self.memoize(id))?,
            b'r' => self.unsigned(4).and_then(|id| self.memoize(id))?,
            0x94 => self.memoize(self.memo.len())?,
            b'h' => self.unsigned(1).and_then(|id| self.push_memo(id))?,
            b'j' => self.unsigned(4).and_then(|id| self.push_memo(id))?,
            // APPEND; APPENDS, ADDITEMS; SETITEM; SETITEMS
            b'a' => self.pop().and_then(|value| self.append(&[value]))?,
            b'e' | 0x90 => self.pop_to_mark().and_then(|values| self.append(&values))?,
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set_items(&[key, value])?;
            }
            b'u' => self.pop_to_mark().and_then(|values| self.set_items(&values))?,
            // BUILD, which sets the fields of an object
            b'b' => drop(self.pop()?),
            // STOP
            b'.' => {
                return match (self.stack.as_slice(), self.marks.len()) {
                    (&[root], 0) => Ok(Some(root)),
                    (values, _) => Err(format!("a pickle that ends with {} values", values.len())),
                };
            }
            _ => {
                let value = self.new_value(opcode)?;
                self.stack.push(self.values.len());
                self.values.push(value);
            }
        }
        Ok(None)
    }

    /// Returns the value that the instruction `opcode` pushes.
    fn new_value(&mut self, opcode: u8) -> Result<Value<'a>, String> {
        Ok(match opcode {
            // EMPTY_LIST, EMPTY_DICT, EMPTY_TUPLE, EMPTY_SET
            b']' => Value::List(vec![]),
            b'}' => Value::Dict(vec![]),
            b')' => Value::Tuple(vec![]),
            0x8f => Value::Object(vec![]),
            // NONE, NEWTRUE, NEWFALSE
            b'N' => Value::None,
            0x88 | 0x89 => Value::Bool(opcode == 0x88),
            // BININT1, BININT2, BININT, LONG1
            b'K' => Value::Int(self.unsigned(1)? as i64),
            b'M' => Value::Int(self.unsigned(2)? as i64),
            b'J' => self.signed(4)?,
            0x8a => self.unsigned(1).and_then(|bytes| self.signed(bytes))?,
            // BINFLOAT
            b'G' => Value::Float(f64::from_be_bytes(self.take(8)?.try_into().expect("eight bytes"))),
            // SHORT_BINUNICODE, BINUNICODE, BINUNICODE8
            0x8c | b'X' | 0x8d => Value::Str(text(self.counted(opcode)?)?),
            // SHORT_BINBYTES, BINBYTES, BINBYTES8, BYTEARRAY8
            b'C' | b'B' | 0x8e | 0x96 => self.counted(opcode).map(|_| Value::Object(vec![]))?,
            // GLOBAL
            b'c' => Value::Global { module: self.line()?, name: self.line()? },
            // STACK_GLOBAL
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                match (&self.values[module], &self.values[name]) {
                    (Value::Str(module), Value::Str(name)) => Value::Global { module, name },
                    _ => return Err("a pickle with a name that is no string".into()),
                }
            }
            // TUPLE, TUPLE1, TUPLE2, TUPLE3
            b't' => Value::Tuple(self.pop_to_mark()?),
            0x85..=0x87 => {
                let mut values = (0..opcode - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
                values.reverse();
                Value::Tuple(values)
            }
            // FROZENSET
            0x91 => self.pop_to_mark().map(|_| Value::Object(vec![]))?,
            // REDUCE
            b'R' => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                self.call(function, arguments)?
            }
            // NEWOBJ, NEWOBJ_EX: instances of classes, which Python creates by `__new__` alone
            0x81 | 0x92 => {
                if opcode == 0x92 {
                    self.pop()?;
                }
                let (_arguments, class) = (self.pop()?, self.pop()?);
                match self.global(class, "with an instance of")? {
                    ("collections", "OrderedDict") => Value::Dict(vec![]),
                    _ => Value::Object(vec![]),
                }
            }
            // BINPERSID
            b'Q' => {
                let id = self.pop()?;
                self.storage(id)?
            }
            opcode => return Err(format!("a pickle with instruction {opcode:#04x}, which no tensors need")),
        })
    }
}

fn text(bytes: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(bytes).map_err(|_| "a pickle with a string that is no UTF-8".into())
}
