//! Values that a pickle creates.

use crate::Dtype;

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
    /// Integer of more than 64 bits; its digits are not kept.
    LargeInt,
    /// Floating-point number.
    Float(f64),
    /// String.
    Str(&'a str),
    /// Function that creates a tensor.
    Rebuild(Rebuild),
    /// Class of dicts that keep their order, which is called to create one.
    OrderedDict,
    /// Class of a storage: the type of its elements.
    Dtype(Dtype),
    /// Anything else that has a name, usually a class.
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
    /// Set, bytes, or data of an unknown class. If it is also a dict: keys and values.
    Object(Vec<(Id, Id)>),
}

/// Function that creates a tensor from other values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rebuild {
    /// `_rebuild_tensor`: from a storage, an offset, a size and a stride. More arguments may follow, such as `requires_grad` and hooks.
    Tensor,
    /// `_rebuild_parameter`: from a tensor.
    Parameter,
    /// `_rebuild_from_type`: from a function that creates a tensor, a class, the arguments of the function, and attributes.
    FromType,
}

impl Value<'_> {
    /// Returns the name of the value's type for error messages, as in "a dict".
    pub fn type_name(&self) -> &'static str {
        match self {
            Value::None | Value::Bool(_) | Value::LargeInt | Value::Float(_) => "a constant",
            Value::Int(_) => "an integer",
            Value::Str(_) => "a string",
            Value::Rebuild(_) | Value::OrderedDict => "a function",
            Value::Dtype(_) => "a type",
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
    pub(crate) values: Vec<Value<'a>>,
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
