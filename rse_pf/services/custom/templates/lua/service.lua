-- @NAME@: compute the centroid and the radius of a point cloud.
-- Request: points, the 3n coordinates of n points, metres, row by row.
-- Reply: centroid, 3 coordinates in metres; radius, the largest distance of a point from it, metres.

return function(request)
  local points = request.points
  if type(points) ~= "table" or #points == 0 or #points % 3 ~= 0 then
    error({code = "bad-request", message = "points must hold rows of 3 numbers"})
  end
  local n = #points / 3
  local centroid = {0, 0, 0}
  for i, value in ipairs(points) do
    local axis = (i - 1) % 3 + 1
    centroid[axis] = centroid[axis] + value / n
  end
  local radius = 0
  for i = 1, #points, 3 do
    local dx, dy, dz = points[i] - centroid[1], points[i + 1] - centroid[2], points[i + 2] - centroid[3]
    radius = math.max(radius, math.sqrt(dx * dx + dy * dy + dz * dz))
  end
  return {centroid = centroid, radius = radius}
end
