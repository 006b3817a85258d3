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
pub fn unpickle(bytes: &[u8]) -> Result<Values<'_>, String> {
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

    fn tuple(&self, id: Id) -> &[Id] {
        match &self.values[id] {
            Value::Tuple(items) => items,
            _ => &[],
        }
    }

    /// Returns the storage of a persistent id: ("storage", its type, its key, the device, its number of elements).
    fn storage(&self, id: Id) -> Result<Value<'a>, String> {
        let unsupported = || "a pickle with a persistent id that is no storage".to_string();
        let &[tag, class, key, device, length] = self.tuple(id) else { return Err(unsupported()) };
        let of = |id: Id| &self.values[id];
        let (Value::Str("storage"), Value::Global { module, name }, Value::Str(key)) =
            (of(tag), of(class), of(key))
        else {
            return Err(unsupported());
        };
        let (Value::Str(_), Value::Int(_)) = (of(device), of(length)) else { return Err(unsupported()) };
        let stored = STORAGES.iter().find(|(_, class)| *module == "torch" && class == name);
        Ok(match (stored, *name) {
            (Some(&(dtype, _)), _) => Value::Storage { dtype, key },
            (None, "UntypedStorage") => Value::Storage { dtype: Dtype::U8, key },
            // Quantized numbers, for example.
            _ => Value::Object(vec![]),
        })
    }

    /// Returns the result of `function` for the tuple `arguments`.
    fn call(&self, function: Id, arguments: Id) -> Result<Value<'a>, String> {
        let &Value::Global { module, name } = &self.values[function] else {
            return Err(format!("a pickle that calls {}", self.values[function].type_name()));
        };
        let arguments = self.tuple(arguments);
        if let Some(made) = self.rebuild(module, name, arguments) {
            return made;
        }
        match (module, name, arguments) {
            ("collections", "OrderedDict", []) => Ok(Value::Dict(vec![])),
            // A function that creates a tensor, a class, the arguments of the function, and attributes.
            ("torch._tensor", "_rebuild_from_type_v2", &[function, _class, arguments, ..]) => {
                let &Value::Global { module, name } = &self.values[function] else {
                    return Err(NO_TENSOR.into());
                };
                let made = self.rebuild(module, name, self.tuple(arguments));
                made.unwrap_or(Ok(Value::Object(vec![])))
            }
            _ if is_plain_constructor(module, name) => Ok(Value::Object(vec![])),
            _ => Err(format!("a pickle that calls {module}.{name}")),
        }
    }

    /// Returns the result of a function that creates a tensor or parameter, or `None` if it is another function. More arguments than those
    /// that are used may follow, such as `requires_grad` and hooks.
    fn rebuild(&self, module: &str, name: &str, arguments: &[Id]) -> Option<Result<Value<'a>, String>> {
        let of = |id: Id| &self.values[id];
        let made = match (module, name, arguments) {
            (
                "torch._utils",
                "_rebuild_tensor" | "_rebuild_tensor_v2",
                &[storage, offset, size, stride, ..],
            ) => match (of(storage), of(offset), of(size), of(stride)) {
                (Value::Storage { .. }, Value::Int(_), Value::Tuple(_), Value::Tuple(_)) => {
                    Some(Value::Tensor { storage, offset, size, stride })
                }
                (Value::Object(_), ..) => Some(Value::Object(vec![])),
                _ => None,
            },
            ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state", &[data, ..]) => {
                Some(of(data).clone()).filter(|data| matches!(data, Value::Tensor { .. } | Value::Object(_)))
            }
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_parameter", _) => None,
            _ => return None,
        };
        Some(made.ok_or(NO_TENSOR.into()))
    }

    /// Pushes an instance of `class`, which Python creates by `__new__` alone.
    fn instance(&mut self, class: Id) -> Result<(), String> {
        let made = match &self.values[class] {
            Value::Global { module: "collections", name: "OrderedDict" } => Value::Dict(vec![]),
            Value::Global { .. } => Value::Object(vec![]),
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
                    self.push(Value::Object(vec![]));
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
                self.push(Value::Global { module, name });
            }
            // STACK_GLOBAL
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (&Value::Str(module), &Value::Str(name)) = (&self.values[module], &self.values[name])
                else {
                    return Err("a pickle with a name that is no string".into());
                };
                self.push(Value::Global { module, name });
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
