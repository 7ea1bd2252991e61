"""Areas as people draw them."""

import json


def geojson(*areas: dict[str, object], frame: str = "map") -> bytes:
    """Rectangles: name, box (low x, low y, high x, high y), further properties."""

    def feature(name: str, box: tuple[float, ...], **more: object) -> dict[str, object]:
        x0, y0, x1, y1 = box
        ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        return {"type": "Feature", "geometry": geometry, "properties": {"name": name} | more}

    features = [feature(**area) for area in areas]  # type: ignore[arg-type]
    return json.dumps({"type": "FeatureCollection", "frame": frame, "features": features}).encode()
