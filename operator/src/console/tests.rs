//! Commands, guard, clutch.
