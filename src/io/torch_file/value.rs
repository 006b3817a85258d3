//! Values that a pickle creates.

use tch::Kind;

/// Index of a value in [`Values`].
pub(crate) type Id = usize;

/// A value that a pickle creates.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value<'a> {
    /// None, a floating-point number, or an integer of more than 64 bits. No field that is read has such a value.
    Constant,
    Truth(bool),
    Integer(i64),
    Text(&'a str),
    /// Function that creates a tensor.
    Rebuild(Rebuild),
    /// Class of dicts that keep their order, which is called to create one.
    OrderedDict,
    /// Type of a storage: the type of its elements.
    Dtype(Kind),
    /// Anything else that has a name, usually a class.
    Named {
        module: &'a str,
        name: &'a str,
    },
    /// Bytes in the file. The device on which they were when they were saved is ignored.
    Storage {
        dtype: Kind,
        key: &'a str,
    },
    /// View of a storage, in elements of the storage.
    Tensor {
        storage: Id,
        offset: Id,
        size: Id,
        stride: Id,
    },
    Tuple(Vec<Id>),
    List(Vec<Id>),
    /// Keys and values, alternating; the last of equal keys counts.
    Dict(Vec<Id>),
    /// Data of an unknown class. If it is also a dict: keys and values, alternating.
    Object(Vec<Id>),
}

/// Function that creates a tensor from other values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Rebuild {
    /// View from a storage, an offset, a size and a stride. More arguments may follow, such as `requires_grad` and hooks.
    View,
    /// Parameter of a model, from a tensor.
    Parameter,
    /// Tensor from a function that creates one, a class, the arguments of the function, and attributes.
    OfClass,
}

impl Value<'_> {
    /// Returns the name of the value's type for error messages.
    pub fn name(&self) -> &'static str {
        match self {
            Value::Constant | Value::Truth(_) => "a constant",
            Value::Integer(_) => "an integer",
            Value::Text(_) => "a string",
            Value::Rebuild(_) | Value::OrderedDict => "a function",
            Value::Dtype(_) => "a type",
            Value::Named { .. } => "a class or a function",
            Value::Storage { .. } => "a storage",
            Value::Tensor { .. } => "a tensor",
            Value::Tuple(_) => "a tuple",
            Value::List(_) => "a list",
            Value::Dict(_) => "a dict",
            Value::Object(_) => "an object",
        }
    }

    /// Returns the number if the value is an integer.
    pub fn integer(&self) -> Option<i64> {
        match self {
            &Value::Integer(number) => Some(number),
            _ => None,
        }
    }
}

/// All values that a pickle created.
#[derive(Debug)]
pub(crate) struct Values<'a> {
    pub(super) values: Vec<Value<'a>>,
    /// Index of the pickle's result.
    pub root: Id,
}

impl<'a> Values<'a> {
    /// Returns the value with index `id`.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id]
    }

    /// Returns an iterator over all values.
    pub fn iter(&self) -> impl Iterator<Item = &Value<'a>> {
        self.values.iter()
    }

    /// Returns the value under `key` in `items`, which are alternating keys and values.
    pub fn entry(&self, items: &[Id], key: &str) -> Option<&Value<'a>> {
        let mut pairs = items.chunks_exact(2).rev();
        pairs.find(|pair| self.values[pair[0]] == Value::Text(key)).map(|pair| &self.values[pair[1]])
    }
}
