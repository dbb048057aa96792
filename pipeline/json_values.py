"""What a JSON document may hold."""

Json = str | int | float | bool | None | list["Json"] | dict[str, "Json"]
