//! What crosses a process: types, the topic table, the codec.
